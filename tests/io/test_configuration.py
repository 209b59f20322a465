"""The configuration of a run: what was typed is what is meant."""

import pytest
import yaml

from spotcheck.cli import main
from spotcheck.errors import InputError
from spotcheck.io.configuration import remark_on_quotes, resolve_config
from tests.conftest import ROOT

DEFAULT = yaml.safe_load((ROOT / "config" / "config.yaml").read_text(encoding="utf-8"))


def read_by_snakemake(*words: str) -> dict:
    """The configuration as Snakemake hands it over: values are YAML of texts, or else the text."""
    out = dict(DEFAULT)
    for key, value in (word.split("=", 1) for word in words):
        try:
            out[key] = yaml.load(value, yaml.BaseLoader)
        except yaml.YAMLError:
            out[key] = value
    return out


ODD = ["lab #3", "monday: cold", "[1] first", "'quoted'", "*star", "a & b", "2024", "012", "no", "- list", "!tag"]


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("key", ["dataset", "results"])
def test_a_path_counts_as_it_was_typed(key, name):
    word = f"{key}=/data/{name}" if name.startswith("lab") else f"{key}={name}"
    assert resolve_config(read_by_snakemake(word), [word])[key] == word.split("=", 1)[1]


def test_a_path_of_the_file_is_text():
    """YAML reads 2024 as a number; a slash at the end is no part of a name."""
    found = resolve_config(DEFAULT | {"dataset": 2024, "results": "out/", "datasets": [7, "b/"]}, [])
    assert (found["dataset"], found["results"], found["datasets"]) == ("2024", "out", ["7", "b"])


@pytest.mark.parametrize("text", ["[lab #3, b]", "[a: b]", "a", "{a: b}", "[[a], b]"])
def test_a_list_that_yaml_reads_otherwise_is_refused(text):
    with pytest.raises(
        InputError, match=r"^config: datasets is .*; it must be a list such as .* in quotes$"
    ) as refused:
        resolve_config(read_by_snakemake(f"datasets={text}"), [f"datasets={text}"])
    assert text in str(refused.value)


def test_a_list_with_quotes_is_read():
    word = "datasets=['lab #3', b]"
    assert resolve_config(read_by_snakemake(word), [word])["datasets"] == ["lab #3", "b"]


@pytest.mark.parametrize("word", ["results=", "dataset=", "results=a{b}"])
def test_what_is_no_path_is_refused(word):
    with pytest.raises(InputError, match=r"^config: .*"):
        resolve_config(read_by_snakemake(word), [word])


def test_odd_names_are_remarked():
    assert {name for name in ODD if remark_on_quotes(name)} == set(ODD) - {"2024", "a & b"}
    assert not [
        name for name in ("my-frames", "my frames", "/data/2024-05-06", "ab#c", "a.b") if remark_on_quotes(name)
    ]


def test_new_dataset_says_so(tmp_path, capsys):
    main(["new-dataset", str(tmp_path / "lab #3")])
    assert "lab #3: this name must stand in quotes" in capsys.readouterr().out
