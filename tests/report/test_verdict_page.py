"""The page of the verdict: every key and status, the thresholds, and a sentence of ours."""

import re

from spotcheck.discrepancy import criteria
from spotcheck.io.schema import read_schema
from tests import write_thresholds
from tests.project.test_docs import code, nested, section, table
from tests.samples.findings_cases import whole
from tests.samples.small_datasets import ROOT

PAGE = ROOT / "workflow" / "docs" / "verdict.md"
# Keys that every value has.
COMMON_KEYS = {"unit", "stderr"}


def test_the_page_describes_every_key():
    """In the order of the schema, with all keys below each; and every status."""
    schema = read_schema("verdict")
    rows = {code(row[0]): row[1] for row in table(section(PAGE, "## verdict.json"), "key")}
    assert list(rows) == list(schema["properties"])
    for name, inner in schema["properties"].items():
        assert nested(inner) - COMMON_KEYS <= set(re.findall(r"`([a-z_0-9]+)`", rows[name])), name
    assert f": {schema['properties']['schema']['const']}." in rows["schema"]
    statuses = table(section(PAGE, "## Statuses"), "status")
    assert [code(row[0]) for row in statuses] == schema["properties"]["status"]["enum"]


def test_the_page_has_the_thresholds():
    """`python -m tests.write_thresholds` writes the table: every constant, with a unit and a reason in its comment. The
    text names no other."""
    page = PAGE.read_text(encoding="utf-8")
    assert write_thresholds.with_threshold_table(page) == page
    names = [code(row[0]) for row in table(section(PAGE, "## Thresholds"), "threshold")]
    assert names == [name for name in vars(criteria) if name.isupper()]
    assert set(re.findall(r"`([A-Z_]{4,})`", page)) == set(names)


def test_the_page_names_modules_of_the_package():
    """Names of files in the section on the method."""
    names = set(re.findall(r"`(\w+\.py)`", section(PAGE, "## Method")))
    assert len(names) > 10
    assert all((ROOT / "workflow" / "spotcheck" / "discrepancy" / name).exists() for name in names)


def test_the_page_shows_a_sentence_of_ours():
    quoted = [line[2:] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("> ")]
    assert "\n".join(quoted) == whole("light and one")["sentence"]
