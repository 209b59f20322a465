"""The page of the verdict: every key and status, the numbers that decide, and a sentence of ours."""

import re

from spotcheck.old_engine import criteria
from spotcheck.old_engine.verdict.document import document
from spotcheck.old_engine.verdict.sentence import sentence
from spotcheck.schema import read_schema
from tests.library.conftest import ROOT
from tests.library.judgements import JUDGEMENTS, WORDS
from tests.library.test_docs import code, nested, section, table

PAGE = ROOT / "workflow" / "docs" / "verdict.md"
# Keys of every number; of p1 and p2 as of any parameter.
SAID_ELSEWHERE = {"unit", "stderr"}


def test_the_page_tells_every_key():
    """In the schema's order, with all keys below it; a row for each status."""
    schema = read_schema("verdict")
    rows = {code(row[0]): row[1] for row in table(section(PAGE, "## verdict.json"), "key")}
    assert list(rows) == list(schema["properties"])
    for name, own in schema["properties"].items():
        assert nested(own) - SAID_ELSEWHERE <= set(re.findall(r"`([a-z_0-9]+)`", rows[name])), name
    statuses = table(section(PAGE, "## What each status means"), "status")
    assert [code(row[0]) for row in statuses] == schema["properties"]["status"]["enum"]


def test_the_page_has_the_numbers_that_decide():
    for name, value, _ in table(section(PAGE, "### The formula that decides"), "number"):
        assert float(value) == getattr(criteria, code(name)).value


def test_the_page_shows_a_sentence_of_ours():
    own = document(JUDGEMENTS["light and one"][1], "small", light_words=WORDS)
    quoted = [line[2:] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("> ")]
    assert "\n".join(quoted) == sentence(own)
