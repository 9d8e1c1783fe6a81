"""The report's page: semantic HTML from numbers and charts; all text of others is escaped."""

from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from typing import Any

from tiler.words.plain_text import printable


class Page:
    """An HTML page that grows section by section.

    Parameters
    ----------
    title : str
        Its title.

    Examples
    --------
    >>> page = Page("A <run>")
    >>> page.section("quality", "Quality", [paragraph("good & <well>")])
    >>> html = page.finish()
    >>> "<title>A &lt;run&gt;</title>" in html, "good &amp; &lt;well&gt;" in html
    (True, True)
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._sections: list[tuple[str, str, str]] = []
        self.lead = ""

    def section(self, name: str, title: str, content: Iterable[str]) -> None:
        """Add a section; `name` is what links to it end in."""
        self._sections.append((name, title, "\n".join(content)))

    def finish(self) -> str:
        """Give the whole page."""
        style = files("tiler.report").joinpath("report.css").read_text(encoding="utf-8")
        links = "".join(f'<li><a href="#{name}">{text(title)}</a></li>' for name, title, _ in self._sections)
        body = "\n".join(
            f'<section id="{name}" aria-labelledby="{name}-title">\n<h2 id="{name}-title">{text(title)}</h2>\n'
            f"{content}\n</section>"
            for name, title, content in self._sections
        )
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<meta name="color-scheme" content="light dark">\n'
            '<link rel="icon" href="data:,">\n'
            f"<title>{text(self._title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
            f"<header>\n<h1>{text(self._title)}</h1>\n{self.lead}\n</header>\n"
            f'<nav aria-label="Contents"><ol>{links}</ol></nav>\n<main>\n{body}\n</main>\n</body>\n</html>\n'
        )


def text(words: object) -> str:
    """Escape text of any origin: one line, no markup."""
    return escape(printable(str(words)))


def paragraph(words: str, style: str = "") -> str:
    """Make a paragraph of plain text."""
    return f"<p{_class(style)}>{text(words)}</p>"


def heading(words: str) -> str:
    """Make a heading within a section."""
    return f"<h3>{text(words)}</h3>"


def figures(pairs: Sequence[tuple[str, str]]) -> str:
    """Make a list of key figures: what it is, and its value."""
    rows = "".join(f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="figures">{rows}</dl>'


def table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[object]], *, numbers: int | None = None
) -> str:
    """Make a table of plain text.

    Parameters
    ----------
    caption : str
        What it shows.
    head : sequence of str
        Titles of the columns.
    rows : iterable of sequences
        Cells; the first of each row is its title.
    numbers : int, optional
        Columns from this one on hold numbers; by default the second.
    """
    first = 1 if numbers is None else numbers
    titles = "".join(
        f'<th scope="col"{_class("number" if k >= first else "")}>{text(name)}</th>' for k, name in enumerate(head)
    )
    body = "\n".join(_row(row, first) for row in rows)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{text(caption)}"><table>'
        f"<caption>{text(caption)}</caption>\n<thead><tr>{titles}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def folded(summary: str, content: str) -> str:
    """Make a part that opens on a click."""
    return f"<details><summary>{text(summary)}</summary>\n{content}\n</details>"


def figure(content: str, caption: str) -> str:
    """Make a figure of a chart or a picture."""
    return f"<figure>{content}<figcaption>{text(caption)}</figcaption></figure>"


def number(value: Any, digits: int = 3) -> str:
    """Write a number, with commas between thousands; a dash where there is none.

    Examples
    --------
    >>> number(1234567), number(0.123456), number(float("nan")), number(None)
    ('1,234,567', '0.123', '-', '-')
    """
    if value is None or value != value:  # noqa: PLR0124 (NaN alone differs from itself)
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{float(value):,.{digits}f}"


def _row(row: Sequence[object], first: int) -> str:
    cells = [f'<th scope="row">{text(row[0])}</th>']
    cells += [
        f"<td{_class('number' if k >= first else '')}>{text(cell)}</td>" for k, cell in enumerate(row[1:], 1)
    ]
    return f"<tr>{''.join(cells)}</tr>"


def _class(style: str) -> str:
    return f' class="{style}"' if style else ""
