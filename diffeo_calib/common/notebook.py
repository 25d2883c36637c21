"""Objects as notebooks show them: small tables of names and values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape


def facts_html(title: str, facts: Mapping[str, object]) -> str:
    """A title over names and values."""
    return table_html(title, (), [[name, str(value)] for name, value in facts.items()])


def table_html(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A title over a table; the first cell of a row is its name."""
    left, right = 'style="text-align:left"', 'style="text-align:right"'
    head = "".join(f"<th {right if k else left}>{escape(name)}</th>" for k, name in enumerate(header))
    lines = [
        "".join(f"<td {right if k and header else left}>{escape(cell)}</td>" for k, cell in enumerate(row))
        for row in rows
    ]
    body = "".join(f"<tr>{line}</tr>" for line in ([head] if head else []) + lines)
    return f"<div><strong>{escape(title)}</strong><table>{body}</table></div>"
