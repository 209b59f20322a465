"""Tables in Markdown, and in plain text."""

from collections.abc import Sequence


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table: the first and the last column to the left, numbers between to the right."""
    lines = [columns, ["---", *["---:"] * (len(columns) - 2), "---"], *rows]
    return [f"| {' | '.join(cell.replace('|', '∣') for cell in line)} |" for line in lines]


def plain(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of the same in columns of one width each."""
    lines = [columns, *rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(columns))]
    sides = ["<", *[">"] * (len(widths) - 2), "<"]
    return [
        "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(line, sides, widths, strict=True)).rstrip()
        for line in lines
    ]
