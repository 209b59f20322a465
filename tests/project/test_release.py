"""What a release needs: one version everywhere, a citation that is one, a changelog with its section."""

import datetime
import re
import tomllib

import yaml

from tests.samples.small_datasets import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
RELEASED = re.findall(
    r"^## \[(\d+\.\d+\.\d+)\] – (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
)


def test_one_version():
    """That of pyproject.toml is the citation's, the rig's, and the first with a section of its own in the changelog."""
    rig = tomllib.loads((ROOT / "workflow" / "rig" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert [CITATION["version"], rig["version"], RELEASED[0][0]] == [PROJECT["version"]] * 3


def test_the_citation():
    """Keys and types that Citation File Format 1.2.0 requires, of the work and of each reference; the day is that of
    the changelog."""
    assert CITATION["cff-version"] == "1.2.0" and CITATION["message"] and CITATION["type"] == "software"
    for own in (CITATION, *CITATION["references"]):
        assert own["title"] and own["type"]
        assert all(author.get("name") or author.get("family-names") for author in own["authors"])
    assert CITATION["license"] == PROJECT["license"]
    assert CITATION["date-released"] == datetime.date.fromisoformat(RELEASED[0][1])
