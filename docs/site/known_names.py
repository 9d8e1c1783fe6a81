"""Names in docstrings: each leads to what its module means by it; one of ours that is not there is an error."""

import sys
from importlib import import_module
from typing import Any

from pages import PACKAGES
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)


def exists(name: str) -> bool:
    """Tell whether a dotted name is that of a module, or of something in one.

    Examples
    --------
    >>> exists("tiler.workflow.run.run"), exists("tiler.workflow.run.walk")
    (True, False)
    """
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        try:
            thing: Any = import_module(".".join(parts[:n]))
        except ModuleNotFoundError:
            continue
        for part in parts[n:]:
            fields = getattr(thing, "__dataclass_fields__", {})
            if part in fields and part == parts[-1]:
                return True
            if not hasattr(thing, part):
                return False
            thing = getattr(thing, part)
        return True
    return False


def settle_names(app: Sphinx, doctree: Any) -> None:
    """Give types their full names; a word in lower case, as the n of ``float64, (n, 2)``, is none."""
    for node in list(doctree.findall(pending_xref)):
        target, module = node.get("reftarget", ""), node.get("py:module")
        if node.get("refdomain") != "py" or node.get("reftype") not in ("class", "exc") or "." in target:
            continue
        if not target[:1].isupper():
            node.replace_self(node.children)
        elif module:
            meant = getattr(sys.modules.get(module), target, None)
            if isinstance(meant, type):
                node["reftarget"] = f"{meant.__module__}.{meant.__qualname__}"


def describe_unknown(app: Sphinx, env: Any, node: Any, contnode: Any) -> None:
    """Warn of a name of ours that leads nowhere; those that no page describes are left as text."""
    target = node.get("reftarget", "")
    if target.split(".")[0] in PACKAGES and "." in target and not exists(target):
        logger.warning("there is no %s", target, location=node, type="ref", subtype="ours")


def setup(app: Sphinx) -> dict[str, bool]:
    """Look at all names once they are read, and at those that Sphinx does not find."""
    app.connect("doctree-read", settle_names)
    app.connect("missing-reference", describe_unknown)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
