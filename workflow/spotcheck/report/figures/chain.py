"""The chain of stages (Fig. 6 of the paper), drawn from what `snakemake --rulegraph` prints."""

import re
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, PathPatch
from matplotlib.path import Path

from spotcheck.errors import InputError
from spotcheck.report.figures import style

NODE = re.compile(r'^\s*"?(\w+)"?\s*\[.*?label\s*=\s*"([^"]*)"')
EDGE = re.compile(r'^\s*"?(\w+)"?\s*->\s*"?(\w+)"?')
SWEEPS = 24
STRAIGHT = 8  # how much harder than others the links pull that should run straight
# Inches: width of a letter at the font size, height of a box, gap between boxes, gap between layers.
LETTER, BOX, GAP, LAYER = 0.075, 0.27, 0.16, 0.30
FONT = 9.0
FACE, EDGE_COLOUR, ENDS = "#e4eef6", "#0072B2", "#fdebd8"


class Graph(NamedTuple):
    """Labels of the nodes by their id, and edges (from, to) from what is made first to what needs it."""

    labels: dict[str, str]
    edges: list[tuple[str, str]]


class Layout(NamedTuple):
    """Nodes of each layer in their order; long edges as chains through placeholders, one in each layer between."""

    layers: list[list[str]]
    chains: list[list[str]]


def parse(dot: str) -> Graph:
    """Nodes and edges of a graph in dot text, sorted by label; lines that are neither are passed over. `InputError`
    when none is left or the edges run in a circle.

    Snakemake numbers and lists the rules in the order of a set, another one in each process: what is drawn must not
    follow it.
    """
    labels: dict[str, str] = {}
    edges: list[tuple[str, str]] = []
    for line in dot.splitlines():
        if edge := EDGE.match(line):
            pair = edge.group(1), edge.group(2)
            if pair[0] != pair[1] and pair not in edges:
                edges.append(pair)
        elif node := NODE.match(line):
            labels[node.group(1)] = node.group(2).replace("\\n", "\n")
    for end in (end for edge_pair in edges for end in edge_pair):
        labels.setdefault(end, end)
    if not labels:
        raise InputError("the rule graph names no rule; it must be what `snakemake --rulegraph` prints")
    order = sorted(labels, key=lambda node: (labels[node], node))
    rank = {node: k for k, node in enumerate(order)}
    graph = Graph({n: labels[n] for n in order}, sorted(edges, key=lambda edge: (rank[edge[0]], rank[edge[1]])))
    depths(graph)
    return graph


def depths(graph: Graph) -> dict[str, int]:
    """Layer of each node: the longest path that leads to it."""
    waiting = {node: {a for a, b in graph.edges if b == node} for node in graph.labels}
    depth: dict[str, int] = {}
    while waiting:
        ready = [node for node, before in waiting.items() if before <= depth.keys()]
        if not ready:
            raise InputError("the rule graph runs in a circle; the rules must form a chain")
        for node in ready:
            depth[node] = max((depth[before] + 1 for before in waiting.pop(node)), default=0)
    return depth


def implied(graph: Graph) -> set[tuple[str, str]]:
    """Edges that a longer way leads along as well: what is left without them is the chain itself."""
    after: dict[str, set[str]] = {}
    depth = depths(graph)
    for node in sorted(graph.labels, key=lambda n: -depth[n]):
        after[node] = set().union(*({b} | after[b] for a, b in graph.edges if a == node))
    return {(a, b) for a, b in graph.edges if any(b in after[c] for x, c in graph.edges if x == a and c != b)}


def layout(graph: Graph) -> Layout:
    """Layers by longest path, order within a layer by repeated barycentres, both ways, best of all sweeps kept."""
    depth = depths(graph)
    layers: list[list[str]] = [[] for _ in range(max(depth.values()) + 1)]
    for node in graph.labels:
        layers[depth[node]].append(node)
    chains = []
    for start, end in graph.edges:
        chain = [start]
        for k in range(depth[start] + 1, depth[end]):
            chain.append(f"{start}->{end}@{k}")
            layers[k].append(chain[-1])
        chains.append([*chain, end])
    links = [pair for chain in chains for pair in pairwise(chain)]
    best, fewest = layers, crossings(layers, links)
    for sweep in range(SWEEPS):
        forward = sweep % 2 == 0
        layers = _sweep(layers, links, forward)
        number = crossings(layers, links)
        if number < fewest:
            best, fewest = layers, number
    return Layout(best, chains)


def crossings(layers: list[list[str]], links: list[tuple[str, str]]) -> int:
    """How many links between neighbouring layers cross."""
    place = {node: k for layer in layers for k, node in enumerate(layer)}
    depth = {node: k for k, layer in enumerate(layers) for node in layer}
    total = 0
    for k in range(len(layers) - 1):
        ends = [(place[a], place[b]) for a, b in links if depth[a] == k]
        total += sum((a - c) * (b - d) < 0 for i, (a, b) in enumerate(ends) for c, d in ends[:i])
    return total


def _sweep(layers: list[list[str]], links: list[tuple[str, str]], forward: bool) -> list[list[str]]:
    """Order each layer by the mean place of its neighbours in the layer before (or after)."""
    ordered = [list(layer) for layer in layers]
    steps = range(1, len(layers)) if forward else range(len(layers) - 2, -1, -1)
    for k in steps:
        place = {node: i for i, node in enumerate(ordered[k - 1 if forward else k + 1])}
        pairs = links if forward else [(b, a) for a, b in links]
        own = {node: i for i, node in enumerate(ordered[k])}

        def centre(node: str, place: dict = place, pairs: list = pairs, own: dict = own) -> float:
            near = [place[a] for a, b in pairs if b == node and a in place]
            return float(np.mean(near)) if near else float(own[node])

        ordered[k].sort(key=centre)
    return ordered


def positions(graph: Graph, found: Layout, sizes: dict[str, float]) -> dict[str, float]:
    """Place of every node across the layers [inch]: each drawn to its neighbours, none nearer than a gap."""
    half = {n: sizes.get(n, 0.06) / 2 for layer in found.layers for n in layer}
    at: dict[str, float] = {}
    for layer in found.layers:
        edge = 0.0
        for node in layer:
            at[node] = edge + half[node]
            edge = at[node] + half[node] + GAP
        middle = (at[layer[0]] + at[layer[-1]]) / 2
        for node in layer:
            at[node] -= middle
    loose = implied(graph)
    near: dict[str, list[str]] = {node: [] for node in at}
    for chain in found.chains:
        for a, b in pairwise(chain):
            # The chain itself should run straight, and so should long edges between their ends.
            weight = STRAIGHT if (chain[0], chain[-1]) not in loose or not {a, b} & graph.labels.keys() else 1
            near[a] += [b] * weight
            near[b] += [a] * weight
    for _ in range(300):
        for layer in found.layers:
            wish = [float(np.mean([at[m] for m in near[n]])) if near[n] else at[n] for n in layer]
            for node, place in zip(layer, _apart(wish, [half[n] for n in layer]), strict=True):
                at[node] = place
    return at


def _apart(wish: list[float], half: list[float]) -> list[float]:
    """Places nearest to the wishes (least squares) that keep order and gaps: pooled where neighbours collide."""
    shift = np.concatenate([[0.0], np.cumsum([a + b + GAP for a, b in pairwise(half)])])
    blocks: list[list[float]] = []  # mean of wishes less shift, and number of nodes
    for value in np.array(wish) - shift:
        blocks.append([float(value), 1.0])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (a, n), (b, m) = blocks[-2:]
            blocks[-2:] = [[(a * n + b * m) / (n + m), n + m]]
    return list(np.concatenate([np.full(int(n), mean) for mean, n in blocks]) + shift)


def draw(graph: Graph) -> style.Drawing:
    """The chain from left to right where it fits the page at a readable size, else from top to bottom."""
    found = layout(graph)
    wide = {n: max(len(line) for line in text.split("\n")) * LETTER + 0.2 for n, text in graph.labels.items()}
    tall = {n: BOX + 0.15 * text.count("\n") for n, text in graph.labels.items()}
    columns = [max((wide[n] for n in layer if n in wide), default=0.1) for layer in found.layers]
    across = sum(columns) + LAYER * (len(columns) - 1) <= style.WIDTH - 0.1
    at = positions(graph, found, tall if across else wide)
    steps = columns if across else [max(tall[n] for n in layer if n in tall) for layer in found.layers]
    start = np.concatenate([[0.0], np.cumsum(np.array(steps[:-1]) + LAYER)])
    along = {n: start[k] + steps[k] / 2 for k, layer in enumerate(found.layers) for n in layer}
    place = {n: (along[n], -at[n]) if across else (at[n], -along[n]) for n in at}
    x = [place[n][0] + s * wide.get(n, 0.0) / 2 for n in place for s in (-1, 1)]
    y = [place[n][1] + s * tall.get(n, 0.0) / 2 for n in place for s in (-1, 1)]
    width, height = np.ptp(x) + 0.2, np.ptp(y) + 0.2
    zoom = min(1.0, style.WIDTH / width)
    figure = Figure(figsize=(max(width * zoom, style.WIDTH), height * zoom))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    ax.set_aspect("equal")
    spare = max(0.0, style.WIDTH - width) / 2 + 0.1
    ax.set_xlim(min(x) - spare, max(x) + spare)
    ax.set_ylim(min(y) - 0.1, max(y) + 0.1)
    loose = implied(graph)
    for chain in found.chains:
        _edge(ax, chain, place, (wide, tall), across, (chain[0], chain[-1]) in loose)
    last = {n for n in graph.labels if n not in {a for a, _ in graph.edges}}
    for node, text in graph.labels.items():
        centre, size = np.array(place[node]), np.array([wide[node], tall[node]])
        rounded = "round,pad=0,rounding_size=0.07"
        face = ENDS if node in last else FACE
        corner = centre - size / 2
        box = FancyBboxPatch(
            (corner[0], corner[1]), size[0], size[1], boxstyle=rounded, facecolor=face, edgecolor=EDGE_COLOUR, zorder=2
        )
        ax.add_patch(box)
        ax.text(centre[0], centre[1], text, ha="center", va="center", fontsize=FONT * zoom, zorder=3)
    caption = (
        f"The chain of the workflow: {len(graph.labels)} stages, an arrow from each to those that read what it wrote,"
        " pale where a longer way leads there too. Shaded differently: what nothing else needs. The"
        " paper's flow chart holds the simulation alone; here the simulated frames pass the very stages that the"
        " measured ones do."
    )
    return style.Drawing(figure, caption)


def _edge(ax: Axes, chain: list[str], place: dict, sizes: tuple[dict, dict], across: bool, faint: bool) -> None:
    """A smooth line through the chain's nodes, from border to border, with an arrow's head at the end."""
    colour, width, order = ("0.8", 0.8, 0.5) if faint else ("0.25", 1.4, 1.0)
    axis, size = (0, sizes[0]) if across else (1, sizes[1])
    sign = 1 if across else -1
    points = [np.array(place[n], float) for n in chain]
    points[0][axis] += sign * size[chain[0]] / 2
    points[-1][axis] -= sign * (size[chain[-1]] / 2 + 0.06)
    vertices, codes = [points[0]], [Path.MOVETO]
    for a, b in pairwise(points):
        lead = np.zeros(2)
        lead[axis] = (b - a)[axis] / 2
        vertices += [a + lead, b - lead, b]
        codes += [Path.CURVE4] * 3
    ax.add_patch(PathPatch(Path(vertices, codes), facecolor="none", edgecolor=colour, linewidth=width, zorder=order))
    tip, back = points[-1].copy(), points[-1].copy()
    tip[axis] += sign * 0.06
    back[axis] -= sign * 0.02
    side = np.array([0.0, 0.035]) if across else np.array([0.035, 0.0])
    ax.fill(*np.array([tip, back + side, back - side]).T, color=colour, linewidth=0, zorder=order)
