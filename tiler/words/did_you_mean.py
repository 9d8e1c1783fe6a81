"""What somebody meant who gave an option, a command or a parameter that there is not."""

import argparse
import re
import sys
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import NoReturn

CLOSE = 0.6  # likeness from which on a name is offered
WRONG_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")


def suggest(name: str, known: Iterable[str]) -> str:
    """Offer the known name that is most like one that is not; an empty text where none is.

    Examples
    --------
    >>> suggest("--meshsize", ["--mesh-size", "--mesher"]), suggest("--colour", ["--mesh-size"])
    ('; did you mean --mesh-size?', '')
    """
    found = get_close_matches(name, list(known), n=1, cutoff=CLOSE)
    return f"; did you mean {found[0]}?" if found else ""


class Parser(argparse.ArgumentParser):
    """A parser whose errors offer what was meant."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2, the error, and what was meant."""
        if found := WRONG_CHOICE.search(message):
            known = [name.strip("'") for name in found[2].split(", ")]
            message += suggest(found[1], known)
        self.print_usage(sys.stderr)
        self.exit(2, f"{self.prog}: error: {message}\n")

    def refuse_unknown(self, words: Sequence[str]) -> NoReturn:
        """End with exit code 2 because of words that are no options of this parser."""
        known = re.findall(r"--[a-z][a-z-]*", self.format_help())
        for word in words:
            name = word.partition("=")[0]
            if name.startswith("-"):
                self.error(f"unknown option {name}{suggest(name, known)}")
        self.error(f"unrecognized arguments: {' '.join(words)}")
