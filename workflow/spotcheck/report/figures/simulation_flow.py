"""Fig. 6 of the paper: the flow of the simulation, with the equation of each step and the stages of the model.

A stage (`model.stage.Stage`) is a point of the forward model at which effects act. The figure shows the effects that
the verdict named beside the stages at which they act.
"""

from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from spotcheck.model.effects import vocabulary
from spotcheck.model.stage import Stage
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

# Sizes [inch]: height of a step and gap below it, left end and width of the boxes, left end of the stages.
STEP_HEIGHT, STEP_GAP = 0.5, 0.16
LEFT, WIDTH, STAGES_LEFT = 0.05, 4.15, 4.35
# Colours of a box and of its border.
FACE, BORDER = "#e4eef6", "#0072B2"


@dataclass(frozen=True)
class Step:
    """A step of the simulation."""

    action: str  # what is computed
    equation: str  # its formula, as mathematical text
    number: str  # numbers of the equations in the paper
    stages: tuple[Stage, ...]  # stages of the model that belong to the step; empty if no effect can act there


STEPS = (
    Step("Irradiance of the laser", r"$E_{la} = 2 P_L / (\pi w^2)$", "Eqs. 9–11", ()),
    Step("Spread in the material", r"$p_b = p_1 \ln t + p_2$", "Eq. 8", (Stage.EXPOSURE,)),
    Step("Width on the sensor", r"$\sigma_g = p_b + M \sigma_{la}/s_{px}$", "Eqs. 7, 10, 21", (Stage.WIDTH,)),
    Step("Photons", r"$\mu_p \propto E_{la}\, t\, \varrho_m \varrho_s \varrho_a \varrho_f,\ \varrho_s = p_b^2/t$",
         "Eqs. 12–14", (Stage.BRIGHTNESS,)),
    Step("Distribution over pixels", r"$\mu_p \exp(-(x^2 + y^2)/2\sigma_g^2)$", "Eqs. 20, 22, 26–28",
         (Stage.COORDINATES, Stage.PROFILE, Stage.BLUR, Stage.ADDED_LIGHT)),
    Step("Top hat", r"cut at $e^{-1/4}$ of the peak", "Eqs. 39, 40", ()),
    Step("Light on the pixels", r"$\mu_p(i, j)$", "Eq. 26",
         (Stage.MODULATION, Stage.SPECKLE_FIELD, Stage.PEDESTAL, Stage.PIXEL_GAIN)),
    Step("Electrons", r"Poisson$(\eta_{qe}\, \mu_p + \mu_d)$", "Eqs. 15, 23–25, 31",
         (Stage.CHARGE, Stage.SMEAR, Stage.WELL)),
    Step("Signal", r"$K \cdot$ (electrons + read noise)", "Eqs. 16, 30",
         (Stage.READ_NOISE, Stage.RESPONSE, Stage.BLACK_LEVEL, Stage.ROW_NOISE_AND_HOT_PIXELS)),
    Step("Frame", "rounded, 0 to full scale, 16-bit file", "Section 5 (3)", (Stage.DIGITAL,)),
)  # fmt: skip


def draw_flow(results: Results) -> style.Drawing:
    """Draw the steps of the simulation from top to bottom, and beside each the stages of the model with its effects."""
    added = _list_effects_by_stage(results)
    height = len(STEPS) * (STEP_HEIGHT + STEP_GAP) + 0.3
    figure = style.new_figure(height)
    ax = figure.add_subplot()
    ax.set(xlim=(0, style.WIDTH), ylim=(height, 0))
    ax.set_axis_off()
    ax.text(LEFT, 0.17, "step of the simulation", color="0.35", fontsize=8)
    ax.text(STAGES_LEFT, 0.17, "stages; effects of the verdict", color="0.35", fontsize=8)
    for k, step in enumerate(STEPS):
        top = 0.3 + k * (STEP_HEIGHT + STEP_GAP)
        _draw_step(ax, step, k + 1, top)
        _write_stages(ax, step, added, top)
        if k + 1 < len(STEPS):
            middle = LEFT + WIDTH / 2
            arrow = {"arrowstyle": "-|>", "color": BORDER, "shrinkA": 0, "shrinkB": 0}
            end = (middle, top + STEP_HEIGHT + STEP_GAP)
            ax.annotate("", end, (middle, top + STEP_HEIGHT), arrowprops=arrow)
    caption = (
        "Flow of the simulation with the paper's equations. Simulated frames pass the same evaluation as the measured"
        " ones. Right: the stages of the model that a step has, at which effects act; in colour, the effects of the"
        " verdict, with which the extended model is simulated."
    )
    return style.Drawing(figure, caption)


def _list_effects_by_stage(results: Results) -> dict[Stage, list[str]]:
    """Return the names of the verdict's effects by stage; {} without a verdict.

    The stage of an effect is the first one of its first variant. Effects outside the vocabulary are left out, and so is
    the learned light, which acts at no stage.
    """
    try:
        names = [effect["name"] for effect in results.verdict()["effects"]]
    except Unavailable:
        return {}
    names_by_stage: dict[Stage, list[str]] = {}
    effects = vocabulary()
    for name in names:
        if name not in effects:
            continue
        # Functions of the first variant; each acts at a stage.
        functions = next(iter(effects[name].variants.values()))
        if functions:
            names_by_stage.setdefault(functions[0].stage, []).append(name.replace("_", " "))
    return names_by_stage


def _draw_step(ax: Axes, step: Step, number: int, top: float) -> None:
    """Draw the box of step `number` (from 1): its action, its formula, and the numbers of the paper's equations.

    `top` is the distance of the box from the upper edge of the figure [inch].
    """
    box = FancyBboxPatch((LEFT + 0.04, top + 0.04), WIDTH - 0.08, STEP_HEIGHT - 0.08, boxstyle="round,pad=0.04",
                         facecolor=FACE, edgecolor=BORDER, linewidth=0.8)  # fmt: skip
    ax.add_patch(box)
    ax.text(LEFT + 0.1, top + 0.19, f"{number}  {step.action}", fontsize=9, fontweight="bold")
    ax.text(LEFT + 0.28, top + 0.4, step.equation, fontsize=9)
    ax.text(LEFT + WIDTH - 0.1, top + 0.19, step.number, fontsize=7.5, color="0.35", ha="right")


def _write_stages(ax: Axes, step: Step, added: dict[Stage, list[str]], top: float) -> None:
    """Write the stages of a step beside its box, and below them the effects that the verdict added there.

    `added` has the names of the effects by stage. `top` is as in `_draw_step`.
    """
    titles = ", ".join(stage.title for stage in step.stages)
    ax.text(STAGES_LEFT, top + 0.19, titles, fontsize=7.5, wrap=True)
    names = [name for stage in step.stages for name in added.get(stage, ())]
    ax.text(STAGES_LEFT, top + 0.4, ", ".join(names), fontsize=8, color=style.ACCENT, fontweight="bold")


FIGURES = (Entry("fig06", "Flow of the simulation", Category.SET_UP, ("simulated",), draw_flow, "Fig. 6"),)
