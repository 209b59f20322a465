"""Draws three pictures for workflow/docs/architecture.md as SVG, and writes its table of the stages of the model.

`python -m tests.draw_architecture` does all of it. The packages and their order are those of the contract in
pyproject.toml. The picture and the table of the model's stages are made from `spotcheck.model.stage.Stage` and the
effects. tests/project/test_docs.py compares stages, files and arrows with the rules, and makes all four again.
"""

import re
import textwrap
import tomllib
from pathlib import Path
from typing import NamedTuple

from spotcheck.model.effect import Effect, RandomStep
from spotcheck.model.effects import built_in
from spotcheck.model.stage import Stage as ModelStage

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "workflow" / "docs"
# What each package does, in a few words.
PURPOSES = {
    "cli": "one subcommand for each stage of the workflow: parse, call, write",
    "quicklook": "a first look at images that nobody has described",
    "report": "figures, pages, comparison of datasets, where a number comes from",
    "paper": "the paper's numbers beside those of the workflow",
    "export": "an instrument file from results, corrected frames",
    "discrepancy": "what the model lacks: detect, name, add, validate, limit, advise",
    "metrics": "PSNR, speckle contrast, peak, sums; of pairs and of single crops",
    "fitting": "spot fit, moments, calibration p1 and p2, caustic, Fisher information",
    "characterization": "EMVA 1288, gain and noise from spots, maps of the pixels",
    "model": "forward model, effects, optics, photons, simulated frames",
    "sensor": "the distribution of one reading: exact, as a table, random",
    "crops": "find the spot, cut it out, set outlier frames aside",
    "dataset": "manifest, instrument, frames; a folder of images becomes a dataset",
    "io": "image formats, netCDF files, schemas, configuration, digests, progress",
    "errors": "InputError",
}


def layers() -> list[list[str]]:
    """Return the packages from the top down, as the contract of imports in pyproject.toml has them."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = (one for one in content["tool"]["importlinter"]["contracts"] if one["type"] == "layers")
    return [layer.split(" | ") for layer in contract["layers"]]


class Stage(NamedTuple):
    """A stage: its rule ("" for what no rule makes), what it writes, column and row in the picture, and the stages
    whose files it takes, as far as no other arrow says so."""

    rule: str
    files: str
    column: int
    row: int
    after: tuple[str, ...] = ()


STAGES = (
    Stage("ingest", "frames.nc", 1, 0),
    Stage("crop", "crops.nc", 2, 0, ("ingest",)),
    Stage("maps", "maps.nc", 2, 2, ("ingest",)),
    Stage("fit", "fits.nc", 3, 0, ("crop", "sensor", "maps")),
    Stage("calibrate", "calibration.nc", 4, 0, ("fit",)),
    Stage("simulate", "simulated.nc", 5, 0, ("calibrate",)),
    Stage("fit_simulated", "simulated/*.nc", 6, 0, ("simulate",)),
    Stage("metrics", "metrics.nc", 7, 0, ("fit_simulated",)),
    Stage("transfer", "transfer.nc", 1, 1, ("ingest",)),
    Stage("sensor", "sensor.nc", 2, 1, ("crop", "transfer")),
    Stage("caustic", "caustic.nc", 3, 1, ("fit",)),
    Stage("bounds", "bounds.nc", 5, 1, ("calibrate",)),
    Stage("precision", "precision.nc", 6, 1, ("fit_simulated",)),
    Stage("judge", "verdict.json, model.yaml", 3, 2, ("sensor",)),
    Stage("extended", "extended_metrics.nc", 4, 1, ("judge", "metrics")),
    Stage("views", "views.nc", 4, 2, ("fit", "judge")),
    Stage("figures", "figures/", 4, 3),
    Stage("paper", "paper_numbers.csv", 4, 4),
    Stage("report", "report.html", 5, 3, ("figures", "paper", "views")),
    Stage("compare", "comparison.html, comparison.nc", 6, 4, ("report",)),
    Stage("notebook", "notebooks/", 6, 3),
)
# What a box is called where its rule has another name.
TITLES = {"fit_simulated": "ingest · crop · fit"}
# Rules that the picture leaves out, or shows as part of a stage.
NOT_SHOWN = ("ingest_simulated", "crop_simulated", "flats", "tables")

INK, FAINT, FILL, LINE = "#1a1a1a", "#555555", "#eef3f8", "#5b7a99"
SANS = "font-family='DejaVu Sans, Verdana, Helvetica, sans-serif'"
MONO = "font-family='DejaVu Sans Mono, Menlo, Consolas, monospace'"


def main() -> None:
    """Write the pictures, and the table into its page."""
    for name, text in pictures().items():
        (DOCS / name).write_text(text, encoding="utf-8")
    page = DOCS / "architecture.md"
    page.write_text(with_stage_table(page.read_text(encoding="utf-8")), encoding="utf-8")


# What stands around the table in the page.
START, END = "<!-- stages of the model: written by tests/draw_architecture.py -->\n\n", "\n<!-- end of the stages -->\n"


def with_stage_table(page: str) -> str:
    """Return the page with its table of the model's stages written anew."""
    return replace_between(page, START, END, stage_table())


def replace_between(page: str, start: str, end: str, content: str) -> str:
    """Return a page with other content between two marks."""
    before, _, rest = page.partition(start)
    after = rest.partition(end)[2]
    assert after, f"the page lacks {start} or {end}"
    return before + start + content + end + after


def stage_table() -> str:
    """Return the stages of the forward model, in the order in which they act, as a table in Markdown."""
    rows = []
    for stage in ModelStage:
        arguments = ", ".join(f"`{argument}`" for argument in stage.value.arguments.split(", "))
        effects = ", ".join(_link(effect, stage) for effect in built_in().values() if stage in effect.stages)
        rows.append(f"| {stage.title} | {arguments} | {stage.value.returns} | {effects or '–'} |\n")
    return "| stage | a function gets | it returns | effects |\n|---|---|---|---|\n" + "".join(rows)


def _link(effect: Effect, stage: ModelStage) -> str:
    """Return the effect's name, with a link to its file, and a star if a variant draws random numbers there."""
    steps = [step for steps in effect.variants.values() for step in steps if step.stage is stage]
    star = "\\*" if any(isinstance(step, RandomStep) for step in steps) else ""
    return f"[{effect.name}](../spotcheck/model/effects/{effect.name}.py){star}"


def pictures() -> dict[str, str]:
    """Content of the pictures by file name."""
    return {"packages.svg": packages(), "stages.svg": stages(), "forward_model.svg": forward_model()}


def packages() -> str:
    """Return the picture of the packages, each above those that it may import from."""
    wide, high, gap = 820, 40, 8
    parts = []
    for row, names in enumerate(layers()):
        y, width = 10 + row * (high + gap), (wide - 20 - gap * (len(names) - 1)) / len(names)
        for column, name in enumerate(names):
            x = 10 + column * (width + gap)
            parts.append(box(x, y, width, high))
            parts.append(text(x + 12, y + 25, name, size=12, bold=True))
            parts.append(text(x + 130, y + 25, PURPOSES[name], size=10.5 if len(names) == 1 else 9.5, colour=FAINT))
    height = 20 + len(layers()) * (high + gap) - gap
    return sheet(wide, height, "Packages of the library; a package imports only from those below it", parts)


# Size of a stage's box and distance from box to box [px].
BOX, STEP = (112, 44), (132, 72)


def stages() -> str:
    """The stages with what they write, and arrows from what they take."""
    at = {own.rule: own for own in STAGES}
    parts = [folder()]
    parts += [arrow(at[name], own) for own in STAGES for name in own.after]
    parts.append(arrow(Stage("", "", 0, 0), at["ingest"]))
    for own in STAGES:
        x, y = corner(own)
        title = TITLES.get(own.rule, own.rule)
        middle, files = x + BOX[0] / 2, own.files.split(", ")
        top = y + (18 if len(files) == 1 else 14)
        parts += [box(x, y, *BOX), text(middle, top, title, size=11 if len(title) < 16 else 10, bold=True, middle=True)]
        parts += [
            text(middle, top + 14 + 11 * k, file, size=9.5, colour=FAINT, middle=True, mono=True)
            for k, file in enumerate(files)
        ]
    x, y = corner(at["figures"])
    parts.append(text(x - 14, y + 20, "from all the files above:", size=10.5, colour=FAINT, end=True))
    width, height = 20 + 7 * STEP[0] + BOX[0], 20 + 4 * STEP[1] + BOX[1]
    return sheet(width, height, "Stages of the workflow and the files that they write", parts)


# Columns of the picture of the model, size of a box and distance from box to box [px].
MODEL_COLUMNS, MODEL_BOX, MODEL_STEP = 4, (206, 76), (226, 98)
# Letters of a line in such a box.
MODEL_LETTERS = 38


def forward_model() -> str:
    """The stages of the forward model, to and fro in rows, with the effects that act at each."""
    parts = []
    members = list(ModelStage)
    first_of_sensor = members.index(ModelStage.CHARGE)
    for k, stage in enumerate(members):
        x, y, step = *_model_corner(k), _model_corner(k + 1)
        fill = "#fff6e5" if k < first_of_sensor else FILL
        parts.append(box(x, y, *MODEL_BOX, fill=fill))
        parts.append(
            text(x + 9, y + 18, f"{k + 1}  {stage.title}", size=11.5 if len(stage.title) < 22 else 10, bold=True)
        )
        unit = re.search(r"\[(.*?)\]", stage.value.returns)
        assert unit is not None
        parts.append(text(x + MODEL_BOX[0] - 9, y + 18, unit.group(1), size=10, colour=FAINT, end=True))
        names = [effect.name for effect in built_in().values() if stage in effect.stages]
        lines = textwrap.wrap(", ".join(names) or "–", MODEL_LETTERS)
        parts += [text(x + 9, y + 43 + 12 * n, line, size=9.5, colour=FAINT) for n, line in enumerate(lines)]
        if k + 1 < len(members):
            parts.append(_model_arrow((x, y), step))
    rows = -(-len(members) // MODEL_COLUMNS)
    x, y = _model_corner(len(members))
    parts.append(_model_arrow(_model_corner(len(members) - 1), (x, y)))
    parts.append(box(x, y, *MODEL_BOX, fill="white"))
    parts.append(text(x + 9, y + 18, "rounding, 0 … full scale", size=11.5, bold=True))
    parts.append(text(x + 9, y + 43, "reading [DN], by ReadingDistribution", size=9.5, colour=FAINT))
    title = "Stages of the forward model, unit of what each passes on, and the effects that act there"
    width = 20 + (MODEL_COLUMNS - 1) * MODEL_STEP[0] + MODEL_BOX[0]
    return sheet(width, 20 + (rows - 1) * MODEL_STEP[1] + MODEL_BOX[1], title, parts)


def _model_corner(k: int) -> tuple[float, float]:
    """Upper left corner of box k: rows run to the right and to the left in turn."""
    row, column = divmod(k, MODEL_COLUMNS)
    return 10 + (MODEL_COLUMNS - 1 - column if row % 2 else column) * MODEL_STEP[0], 10 + row * MODEL_STEP[1]


def _model_arrow(start: tuple[float, float], end: tuple[float, float]) -> str:
    """An arrow from a box to the next one beside or below it."""
    (x1, y1), (x2, y2) = start, end
    if x1 == x2:
        x1, y1, x2, y2 = x1 + MODEL_BOX[0] / 2, y1 + MODEL_BOX[1], x2 + MODEL_BOX[0] / 2, y2 - 2
    else:
        y1, y2 = y1 + MODEL_BOX[1] / 2, y2 + MODEL_BOX[1] / 2
        x1, x2 = (x1 + MODEL_BOX[0], x2 - 2) if x2 > x1 else (x1, x2 + MODEL_BOX[0] + 2)
    path = f"M{x1:g},{y1:g} L{x2:g},{y2:g}"
    return f"<path d='{path}' fill='none' stroke='{LINE}' stroke-width='1.3' marker-end='url(#tip)'/>\n"


def folder() -> str:
    """The dataset, where everything starts."""
    x, y = corner(Stage("", "", 0, 0))
    lines = ("manifest.csv", "instrument.yaml", "frames/")
    written = [text(x + 8, y + 34 + 14 * k, line, size=9, colour=FAINT, mono=True) for k, line in enumerate(lines)]
    return "".join(
        [box(x, y, BOX[0], 74, fill="#fff6e5"), text(x + 8, y + 18, "dataset", size=11.5, bold=True), *written]
    )


def corner(own: Stage) -> tuple[float, float]:
    """Upper left corner of a stage's box."""
    return 10 + own.column * STEP[0], 10 + own.row * STEP[1]


def arrow(start: Stage, end: Stage) -> str:
    """An arrow between two boxes: across in a row, down in a column, else from side to side."""
    (x1, y1), (x2, y2) = corner(start), corner(end)
    if start.column == end.column:
        x1, y1, x2 = x1 + BOX[0] / 2, y1 + BOX[1], x2 + BOX[0] / 2
        path = f"M{x1:g},{y1:g} L{x2:g},{y2 - 2:g}"
    else:
        x1, y1, y2 = x1 + BOX[0], y1 + BOX[1] / 2, y2 + BOX[1] / 2
        half = (x1 + x2) / 2
        path = f"M{x1:g},{y1:g} C{half:g},{y1:g} {half:g},{y2:g} {x2 - 2:g},{y2:g}"
    return f"<path d='{path}' fill='none' stroke='{LINE}' stroke-width='1.3' marker-end='url(#tip)'/>\n"


def box(x: float, y: float, width: float, height: float, fill: str = FILL) -> str:
    """A rounded box."""
    place = f"x='{x:.1f}' y='{y:.1f}' width='{width:.1f}' height='{height:.1f}'"
    return f"<rect {place} rx='5' fill='{fill}' stroke='{LINE}'/>\n"


def text(
    x: float, y: float, said: str, size: float, *, colour: str = INK, bold: bool = False, middle: bool = False,
    end: bool = False, mono: bool = False,
) -> str:  # fmt: skip
    """A line of text on its base line."""
    anchor = "middle" if middle else "end" if end else "start"
    weight = " font-weight='bold'" if bold else ""
    look = f"{MONO if mono else SANS} font-size='{size:g}' fill='{colour}' text-anchor='{anchor}'{weight}"
    return f"<text x='{x:.1f}' y='{y:.1f}' {look}>{said}</text>\n"


def sheet(width: float, height: float, title: str, parts: list[str]) -> str:
    """A white sheet with the parts on it."""
    tip = f"<path d='M0,0 L7,3 L0,6 z' fill='{LINE}'/>"
    marker = f"<marker id='tip' markerWidth='8' markerHeight='6' refX='6' refY='3' orient='auto'>{tip}</marker>"
    head = f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width:g} {height:g}' role='img'>\n"
    ground = f"<title>{title}</title>\n<defs>{marker}</defs>\n<rect width='100%' height='100%' fill='white'/>\n"
    return head + ground + "".join(parts) + "</svg>\n"


if __name__ == "__main__":
    main()
