"""Examples in the help of subcommands are commands that run, and the main help lists every subcommand once."""

import re
import shlex
import shutil
import webbrowser
from pathlib import Path

import pytest

from spotcheck import cli
from spotcheck.model.effects import choose, chosen
from tests.samples.small_datasets import ROOT

# Subcommands that need results of other stages as well; what brings these is run before them.
BEFORE = {
    "metrics": (
        "ingest out/my-frames/simulated --output out/my-frames/simulated/frames.nc",
        "crop out/my-frames/simulated --frames out/my-frames/simulated/frames.nc"
        " --output out/my-frames/simulated/crops.nc",
        "fit my-frames --crops out/my-frames/simulated/crops.nc --sensor out/my-frames/sensor.nc"
        " --output out/my-frames/simulated/fits.nc",
    ),
    "transfer": ("ingest my-flats --output out/my-flats/frames.nc",),
    "maps": ("ingest my-flats --output out/my-flats/frames.nc",),
}
# `paper` wants the default dataset's results, which take minutes, and all figures take 15 s.
PARSED_ONLY = ("paper", "figures")


def examples(name: str, capsys) -> list[list[str]]:
    """Words after `spotcheck` of each example in a subcommand's help; a remark stands behind # or three blanks."""
    with pytest.raises(SystemExit):
        cli.parse([name, "--help"])
    found = re.split(r"^examples?:$", capsys.readouterr().out, maxsplit=1, flags=re.MULTILINE | re.IGNORECASE)
    assert len(found) == 2, f"{name}: its help has no example"
    lines = [line.strip() for line in re.sub(r"\\\n\s*", "", found[1]).splitlines()]
    return [
        shlex.split(re.split(r"\s{3,}", line)[0], comments=True)[1:] for line in lines if line.startswith("spotcheck ")
    ]


@pytest.fixture
def prepared(shelf, tmp_path, monkeypatch) -> Path:
    """A working directory with what examples name: datasets, their results so far, and the repository's own folders."""
    for name in ("my-frames", "my-flats"):
        shutil.copytree(shelf / name, tmp_path / name)
    for name in ("data", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    results = tmp_path / "out" / "my-frames"
    results.mkdir(parents=True)
    (results / ".dataset").write_text(str(tmp_path / "my-frames"))
    (tmp_path / "rules.dot").write_text('digraph {\n0[label = "fit"];\n1[label = "crop"];\n1 -> 0\n}\n')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda page: True)
    before = chosen()
    yield tmp_path
    choose(before)


def test_examples_run(prepared, capsys):
    """Those of all subcommands, one after another: each stage takes what those before it wrote."""
    stages = next(commands for title, commands in cli.GROUPS.items() if title.startswith("stages"))
    # The report shows what `chain` draws.
    for name in dict.fromkeys([*stages, *cli.COMMANDS]):
        for words in BEFORE.get(name, ()):
            cli.run(words.split())
        found = examples(name, capsys)
        assert found, name
        for words in found:
            assert words[0] == name
            if name in PARSED_ONLY:
                cli.parse(words)
            else:
                cli.run(words)
                assert capsys.readouterr().out, name


def test_the_main_help_lists_every_subcommand(capsys):
    """Once, in one group, with its sentence."""
    listed = [name for names in cli.GROUPS.values() for name in names]
    assert sorted(listed) == sorted(cli.COMMANDS)
    with pytest.raises(SystemExit):
        cli.parse(["--help"])
    shown = re.findall(r"^  (\S+) +(.+)$", capsys.readouterr().out, re.MULTILINE)
    assert [own for own in shown if own[0] in cli.COMMANDS] == [(name, cli.COMMANDS[name]) for name in listed]
