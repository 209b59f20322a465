"""Pages that a person reads: tables list what the code has, messages are the code's own, links lead somewhere."""

import io
import json
import pkgutil
import re
from contextlib import redirect_stdout
from pathlib import Path

import imagecodecs
import matplotlib.pyplot
import numpy as np
import pytest
import tifffile

import spotcheck
from spotcheck.characterization.levels import PHOTONS
from spotcheck.cli import COMMANDS
from spotcheck.crops.ingest import check_dataset
from spotcheck.dataset import folder as dataset
from spotcheck.dataset.frames import read_image
from spotcheck.dataset.manifest import DATE, KEEP, REQUIRED_COLUMNS
from spotcheck.errors import InputError
from spotcheck.fitting.scan_caustic import CONDITION
from spotcheck.io.schema import read_schema
from spotcheck.metrics.crop_metrics import Metric
from spotcheck.model.effects import vocabulary
from spotcheck.model.stage import Stage
from tests import check_readme, draw_architecture
from tests.samples.small_datasets import HEADER, ROOT, folder, loaded

DOCS = ROOT / "workflow" / "docs"
CONTRACT = DOCS / "dataset-contract.md"
PAGES = sorted([ROOT / "README.md", ROOT / "config" / "README.md", ROOT / "CHANGELOG.md", *DOCS.glob("*.md")])


def section(path: Path, heading: str) -> str:
    """Text of a page below a heading, up to the next one of the same depth or above."""
    depth = len(heading.split()[0])
    after = path.read_text(encoding="utf-8").split(f"\n{heading}\n")[1]
    return re.split(rf"\n#{{1,{depth}}} ", after)[0]


def table(text: str, head: str) -> list[list[str]]:
    """Cells of the rows of the table whose first column is called `head`."""
    lines = text[text.index(f"| {head} |") :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def code(cell: str) -> str:
    """What stands between backticks, or the cell as it is."""
    return cell.strip("`") if cell.count("`") == 2 else cell


# What pages quote. Blocks that a run wrote are held by `make check-numbers`.


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_numbers_of_other_pages_are_quoted_rightly(path):
    """Where a page takes a number from a table of another."""
    text = path.read_text(encoding="utf-8")
    assert check_readme.with_numbers(text) == text
    # Rendered, a line that starts with a comment would lose its links.
    assert not re.search(r"^\s*<!-- [\w-]+\.md: ", text, re.MULTILINE)


def test_the_readme():
    """Short, with the paper's count as its page has it, and the number of effects that a verdict searches for."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    (quoted,) = [found[2] for found in check_readme.pattern("numbers").finditer(text)]
    assert quoted.split() == check_readme.quoted(DOCS / "paper.md", "numbers", first=True).split()
    assert {int(number) for number in re.findall(r"(\d+)\s+effects", text)} == {len(vocabulary())}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_and_functions_are_there(path):
    """Targets of the Makefile, subcommands, and public names of the library, wherever a page names one but as gone."""
    text = re.sub(r"^### Removed\n.*?(?=^#)", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(re.findall(r"(?:`|^    |\" )make ([a-z-]+)", text, re.MULTILINE)) <= set(targets)
    assert set(re.findall(r"(?:`|bin/|^    )spotcheck ([a-z-]+)", text, re.MULTILINE)) <= set(COMMANDS)
    # A path of two names or more, as `spotcheck.sensor.ReadingDistribution`, names something of a module.
    for path in re.findall(r"\bspotcheck\.[A-Za-z_.]+\.[A-Za-z_]+\b", text):
        assert pkgutil.resolve_name(path), path
    assert set(re.findall(r"(?<!from )\bspotcheck\.([A-Za-z_]+)\b(?!\.)", text)) <= set(spotcheck.__all__)


def test_check_readme_tells_and_mends(tmp_path, monkeypatch):
    """A stale number and a stale block are refused, and right after --write."""
    monkeypatch.setattr(check_readme, "DOCS", tmp_path)
    (tmp_path / "scores.md").write_text("| row | × 2.5 (2.4–2.6) | 7 |\n")
    (tmp_path / "verdict.json").write_text(json.dumps({"sentence": "All is well."}))
    page = tmp_path / "page.md"
    page.write_text("A <!-- scores.md: row -->9<!-- / --> b\n<!-- said: here -->\nold\n<!-- /said -->\n")
    for more in ([], ["said", str(tmp_path / "verdict.json")]):
        monkeypatch.setattr("sys.argv", ["check_readme.py", str(page), *more])
        with pytest.raises(SystemExit, match="quotes something else than"):
            check_readme.main()
        monkeypatch.setattr("sys.argv", ["check_readme.py", str(page), *more, "--write"])
        check_readme.main()
        monkeypatch.setattr("sys.argv", ["check_readme.py", str(page), *more])
        check_readme.main()
    assert page.read_text() == (
        "A <!-- scores.md: row -->2.5<!-- / --> b\n<!-- said: here -->\n> All is well.\n<!-- /said -->\n"
    )


def run_blocks(page: Path) -> None:
    """Run every block of code of a page, one after another; what it prints must be the block below it."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```\n(?:\n```text\n(.*?)```)?", text, re.DOTALL)
    assert len(blocks) == text.count("```python") > 3
    names: dict = {}
    for code_of_block, wanted in blocks:
        with redirect_stdout(printed := io.StringIO()):
            exec(code_of_block, names)
        assert printed.getvalue() == wanted, code_of_block


def test_the_tutorial_runs(monkeypatch):
    """Every block of code, in the folder of the repository; what it prints is the block below it. A number in the last
    digit shown is far above what another processor changes."""
    monkeypatch.chdir(ROOT)
    matplotlib.use("agg")
    try:
        run_blocks(DOCS / "tutorial.md")
        assert len(matplotlib.pyplot.get_fignums()) == 3
    finally:
        matplotlib.pyplot.close("all")


def test_the_reference_has_every_public_name():
    """Each once."""
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\.\. auto\w+:: (\w+)", text, re.MULTILINE)) == sorted(
        name for name in spotcheck.__all__ if name != "__version__"
    )


# The dataset contract.


def test_columns_of_the_manifest():
    """Those that are required, those that some stage knows, and the rest."""
    rows = table(section(CONTRACT, "## manifest.csv"), "column")
    assert [code(row[0]) for row in rows] == [*REQUIRED_COLUMNS, "page", PHOTONS, CONDITION, DATE, KEEP, "any other"]


def instrument_keys() -> dict[str, dict]:
    """Every key of instrument.yaml with its section, and what the schema says of it."""
    out = {}
    for name, own in read_schema("instrument")["properties"].items():
        if own["type"] == "object":
            out |= {f"{name}.{key}": content for key, content in own["properties"].items()}
        else:
            out[name] = own
    return out


def test_keys_of_the_instrument_file():
    """In the schema's order, with its defaults and units."""
    rows = table(section(CONTRACT, "## instrument.yaml"), "key")
    assert [code(row[0]) for row in rows] == list(instrument_keys())
    for (key, unit, default, meaning), own in zip(rows, instrument_keys().values(), strict=True):
        assert ("default" in own) == ("`" in default), key
        assert "default" not in own or json.dumps(own["default"]).strip('"') == code(default), key
        said = re.search(r"\[(.+?)\]", own["description"])
        assert unit == (said[1] if said else "bit" if "bit" in key else ""), key
        assert meaning
        for choice in own.get("enum", ()):
            assert f"`{choice}`" in meaning, key


def test_photon_budgets():
    """A row for each choice."""
    rows = table(section(CONTRACT, "### The baseline model"), "value")
    assert {code(row[0]) for row in rows} == set(instrument_keys()["model.photon_budget"]["enum"])


def nested(schema: dict) -> set[str]:
    """Names of all keys below a part of a schema."""
    out: set[str] = set()
    for name, own in schema.get("properties", {}).items():
        out |= {name} | nested(own)
    for inner in (schema.get("items"), schema.get("additionalProperties")):
        out |= nested(inner) if isinstance(inner, dict) else set()
    return out


GOOD = "frames/a.tif,spot,0,1e-4,0"


def manifest(*rows: str, header: str = HEADER):
    """Loading a dataset of these rows."""
    return lambda base: dataset.load(folder(base, list(rows), header=header))


def instrument(text: str):
    """Loading a dataset with this instrument file."""
    return lambda base: dataset.load(folder(base, [GOOD], text))


def beside(row: str, *files: str):
    """Checking a dataset of one row with empty files in frames/."""

    def check(base):
        found = dataset.load(folder(base, [row]))
        for name in files:
            (base / "frames" / name).touch()
        dataset.check_files(found)

    return check


def image(pixels: np.ndarray, text: str = "", **options):
    """Checking and reading a dataset of one image, written with options."""
    out = io.BytesIO()
    tifffile.imwrite(out, pixels, **options)
    return content(out.getvalue(), text)


def content(of_file: bytes, text: str = ""):
    """Checking and reading a dataset of one file."""

    def check(base):
        found = dataset.load(folder(base, [GOOD], text))
        (base / "frames" / "a.tif").write_bytes(of_file)
        check_dataset(found)
        read_image(found, found.frames[0])

    return check


def inverted_mask(base):
    """Checking a dataset of one image whose mask is 0 at its only bad pixel."""
    pixels = np.full((240, 320), 255, np.uint8)
    pixels[119, 165] = 0
    (base / "mask.png").write_bytes(imagecodecs.png_encode(pixels))
    image(np.zeros((240, 320), np.uint16), "bad_pixels: {mask: mask.png}")(base)


MISTAKES = {
    "a required column is missing": manifest("frames/a.tif,spot,0,1e-4", header=HEADER.removesuffix(",repeat")),
    "an unknown kind": manifest(GOOD.replace("spot", "sopt")),
    "a unit in a number": manifest(GOOD.replace("1e-4", "0.1ms")),
    "a word in `keep`": manifest(f"{GOOD},1", header=f"{HEADER},keep"),
    "two rows for one frame": manifest(GOOD, GOOD),
    "a gap in a column": manifest(GOOD, "frames/b.tif,spot,0,,1"),
    "a file that is not there": beside(GOOD),
    "a file in another place": beside(GOOD, "../a.tif"),
    "an image without a row": beside(GOOD, "a.tif", "b.tif"),
    "a stack without rows for its pages": image(np.zeros((9, 40, 50), np.uint16), photometric="minisblack"),
    "a misspelt key": instrument("croppx: 240"),
    "a key in the wrong place": instrument("f_number: 11"),
    "a value out of range": instrument("sensor: {bit_depth: 17}"),
    "a colour image": image(np.zeros((40, 50, 3), np.uint8)),
    "values turned into colours": image(
        np.zeros((40, 50), np.uint8), photometric="palette", colormap=np.zeros((3, 256), np.uint16)
    ),
    "another format by the name of one that is read": content(b"BM"),
    "a crop that is too large": image(np.zeros((30, 40), np.uint16)),
    "a profile that is not there": instrument("light: {profile: light.nc}"),
    "an inverted mask of bad pixels": inverted_mask,
    "a bad column beyond the frame": image(
        np.zeros((240, 320), np.uint16), "crop_px: 24\nbad_pixels: {columns: [400]}"
    ),
    "a wrong bit depth": image(np.full((40, 50), 1024, np.uint16), "crop_px: 24\nsensor: {bit_depth: 10}"),
}


def test_every_mistake_of_the_page_is_tried():
    rows = table(section(CONTRACT, "## Mistakes and their messages"), "mistake")
    assert [row[0] for row in rows] == list(MISTAKES)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_messages_are_the_programs_own(mistake, tmp_path):
    """Word by word, backticks apart."""
    rows = dict(table(section(CONTRACT, "## Mistakes and their messages"), "mistake"))
    with pytest.raises(InputError) as caught:
        MISTAKES[mistake](tmp_path)
    assert str(caught.value).replace("`", "") == code(rows[mistake])


def test_the_smallest_dataset_is_one(tmp_path):
    """The page's manifest of two lines."""
    text = section(CONTRACT, "## A first dataset")
    header, row = re.search(r"(    file,kind.*\n)(    frames/.*\n)", text).groups()
    found = loaded(tmp_path, [np.zeros((300, 300), np.uint16)])
    (tmp_path / "frames" / "f0.tif").rename(tmp_path / "frames" / "spot.tif")
    (tmp_path / "manifest.csv").write_text(header.strip() + "\n" + row.strip() + "\n")
    found = dataset.load(tmp_path)
    check_dataset(found)
    assert found.shape == (1, 1, 1)


# Architecture.

RULES = ROOT / "workflow" / "rules"


def rules() -> dict[str, str]:
    """Text of every rule by name, with that of the functions in common.smk that it names."""
    found = {}
    helpers = re.split(r"^def ", (RULES / "common.smk").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    for path in RULES.glob("*.smk"):
        for part in re.split(r"^ *(?=(?:use )?rule )", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
            named = re.match(r"(?:use rule \w+ as|rule) (\w+)", part)
            found[named[1]] = (
                found.get(named[1], "")
                + part
                + "".join(own for own in helpers if re.search(rf"\b{own.split('(')[0]}\b", part))
            )
    return found


@pytest.mark.parametrize("name", draw_architecture.pictures())
def test_pictures_are_drawn_from_the_code(name):
    """`python -m tests.draw_architecture` draws what the page shows."""
    assert (DOCS / name).read_text(encoding="utf-8") == draw_architecture.pictures()[name]


def test_the_table_of_the_models_stages_is_made_from_the_code():
    """`python -m tests.draw_architecture` writes it into the page: every stage, and every effect that acts at one."""
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    assert draw_architecture.with_stage_table(page) == page
    rows = table(section(DOCS / "architecture.md", "## The stages of the forward model"), "stage")
    assert [row[0] for row in rows] == [stage.title for stage in Stage]
    named = {name for row in rows for name in re.findall(r"\[(\w+)\]", row[3])}
    assert named == {effect.name for effect in vocabulary().values() if effect.stages}


def test_every_rule_is_in_the_picture():
    """Or among those that it leaves out."""
    shown = [own.rule for own in draw_architecture.STAGES]
    assert sorted([*shown, *draw_architecture.NOT_SHOWN]) == sorted(rules())


@pytest.mark.parametrize("own", draw_architecture.STAGES, ids=lambda own: own.rule)
def test_stages_write_and_take_what_the_picture_says(own):
    """A rule names its own files, and those of the stages from which an arrow leads to it."""
    text = rules()[own.rule]
    for file in own.files.split(", "):
        assert file.strip("/").split("/*")[0] in text, file
    files = {stage.rule: stage.files for stage in draw_architecture.STAGES}
    for name in own.after:
        assert f"rules.{name}.output" in text or files[name].split(".")[0] in text, name


def test_the_table_of_stages():
    """Every stage of the picture with its file."""
    rows = table(section(DOCS / "architecture.md", "## Data flow"), "stage")
    told = {name: row[2] for row in rows for name in re.findall(r"`(\w+)`", row[0])}
    titles = draw_architecture.TITLES
    shown = {titles.get(own.rule, own.rule): own.files for own in draw_architecture.STAGES if "*" not in own.files}
    assert set(told) == set(shown)
    for name, files in shown.items():
        assert all(f"`{file}`" in told[name] for file in files.split(", "))


def test_the_pages_metric_is_one():
    """Its function, and the form of its row."""
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    (text,) = [own.split("```")[0] for own in page.split("```python\n")[1:] if "PER_IMAGE" in own]
    names = {"np": np, "Metric": Metric}
    exec(text.replace("    ...,\n", ""), names)
    (row,) = names["PER_IMAGE"]
    assert row.units and row.long_name
    assert row.function(np.array([[0.0, 4.0], [1.0, np.nan]])) == pytest.approx(1 / 3)


# Links.


def anchors(path: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    texts = [re.sub(r"\[(.+?)\]\(.+?\)", r"\1", head).lower() for head in heads]
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in texts}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    """Files that are there, and headings of theirs."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("http"):
            continue
        file, _, anchor = target.partition("#")
        goal = (path.parent / file).resolve() if file else path
        assert goal.exists(), target
        assert goal.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(goal), target
