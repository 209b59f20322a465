"""Flow chart of the workflow (Fig. 6 of the paper), drawn from the output of `snakemake --rulegraph`.

The layout follows K. Sugiyama, S. Tagawa and M. Toda (IEEE Trans. Syst. Man Cybern. 11, 109, 1981): nodes are placed in
layers, each layer is ordered by barycentres, and coordinates follow by least squares.
"""

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
# Sweeps that order the layers, and iterations that place the nodes.
SWEEPS, ITERATIONS = 24, 300
# Weight of links that should be straight, relative to other links.
STRAIGHT_WEIGHT = 8
# Width of a letter, height of a box and of each further line, gap between boxes, gap between layers, and extent of a
# placeholder [inch].
LETTER, BOX, LINE, GAP, LAYER_GAP, PLACEHOLDER = 0.075, 0.27, 0.15, 0.16, 0.30, 0.06
# Length of an arrow head and half its width [inch].
ARROW_LENGTH, ARROW_HALF_WIDTH = 0.06, 0.035
FONT_SIZE = 9.0
FACE, EDGE_COLOUR, FINAL_FACE = "#e4eef6", "#0072B2", "#fdebd8"

Edge = tuple[str, str]


class Graph(NamedTuple):
    """Rules and their dependencies."""

    labels: dict[str, str]  # label of each node by its id
    edges: list[Edge]  # pairs (id of a rule, id of a rule that reads its output)


class Layout(NamedTuple):
    """Layers of the graph."""

    layers: list[list[str]]  # nodes and placeholders of each layer, in their order
    chains: list[list[str]]  # each edge as a path with one placeholder per layer that it crosses


class Drawn(NamedTuple):
    """Positions and sizes of the nodes in the drawing [inch]."""

    places: dict[str, tuple[float, float]]  # centre (x, y) of each node and placeholder
    widths: dict[str, float]  # width of the box of each node
    heights: dict[str, float]  # height of the box of each node
    is_horizontal: bool  # whether layers are columns, from left to right; else rows, from top to bottom


def parse_graph(dot: str) -> Graph:
    """Return the nodes and edges of a graph in dot text, sorted by label; other lines are ignored.

    The order of Snakemake's output differs between processes, and the drawing must not depend on it. Raises
    `InputError` if there is no node or if the edges form a circle.
    """
    labels: dict[str, str] = {}
    edges: list[Edge] = []
    for line in dot.splitlines():
        if match := EDGE.match(line):
            edge = match.group(1), match.group(2)
            if edge[0] != edge[1] and edge not in edges:
                edges.append(edge)
        elif match := NODE.match(line):
            labels[match.group(1)] = match.group(2).replace("\\n", "\n")
    for edge in edges:
        for node in edge:
            labels.setdefault(node, node)
    if not labels:
        raise InputError("the rule graph names no rule; it must be what `snakemake --rulegraph` prints")
    order = sorted(labels, key=lambda node: (labels[node], node))
    rank = {node: k for k, node in enumerate(order)}
    graph = Graph(
        {node: labels[node] for node in order}, sorted(edges, key=lambda edge: (rank[edge[0]], rank[edge[1]]))
    )
    find_depths(graph)
    return graph


def find_depths(graph: Graph) -> dict[str, int]:
    """Return the layer of each node, the length of the longest path to it. Raises `InputError` for a circle."""
    waiting = {node: {start for start, end in graph.edges if end == node} for node in graph.labels}
    depth: dict[str, int] = {}
    while waiting:
        ready = [node for node, before in waiting.items() if before <= depth.keys()]
        if not ready:
            raise InputError("the rule graph runs in a circle; the rules must form a chain")
        for node in ready:
            depth[node] = max((depth[before] + 1 for before in waiting.pop(node)), default=0)
    return depth


def find_redundant_edges(graph: Graph) -> set[Edge]:
    """Return the edges between nodes that a longer path connects as well."""
    depth = find_depths(graph)
    next_nodes = {node: {end for start, end in graph.edges if start == node} for node in graph.labels}
    reachable: dict[str, set[str]] = {}
    for node in sorted(graph.labels, key=lambda node: -depth[node]):
        reachable[node] = next_nodes[node].union(*(reachable[after] for after in next_nodes[node]))
    return {(start, end) for start, end in graph.edges if any(end in reachable[via] for via in next_nodes[start])}


def find_layout(graph: Graph) -> Layout:
    """Return the layers of a graph, ordered by barycentres so that few links cross."""
    depth = find_depths(graph)
    layers: list[list[str]] = [[] for _ in range(max(depth.values()) + 1)]
    for node in graph.labels:
        layers[depth[node]].append(node)
    chains = []
    for start, end in graph.edges:
        placeholders = {k: f"{start}->{end}@{k}" for k in range(depth[start] + 1, depth[end])}
        for k, placeholder in placeholders.items():
            layers[k].append(placeholder)
        chains.append([start, *placeholders.values(), end])
    links = [link for chain in chains for link in pairwise(chain)]
    best, fewest = layers, count_crossings(layers, links)
    for sweep in range(SWEEPS):
        layers = _order_layers(layers, links, is_forward=sweep % 2 == 0)
        count = count_crossings(layers, links)
        if count < fewest:
            best, fewest = layers, count
    return Layout(best, chains)


def count_crossings(layers: list[list[str]], links: list[Edge]) -> int:
    """Return the number of crossings of links between neighbouring layers."""
    place = {node: k for layer in layers for k, node in enumerate(layer)}
    depth = {node: k for k, layer in enumerate(layers) for node in layer}
    total = 0
    for k in range(len(layers) - 1):
        ends = [(place[start], place[end]) for start, end in links if depth[start] == k]
        total += sum((a - c) * (b - d) < 0 for i, (a, b) in enumerate(ends) for c, d in ends[:i])
    return total


def _order_layers(layers: list[list[str]], links: list[Edge], is_forward: bool) -> list[list[str]]:
    """Order each layer by the mean place of its neighbours in the previous layer, or in the next one."""
    ordered = [list(layer) for layer in layers]
    step = 1 if is_forward else -1
    pairs = links if is_forward else [(end, start) for start, end in links]
    for k in range(1, len(layers)) if is_forward else range(len(layers) - 2, -1, -1):
        place = {node: i for i, node in enumerate(ordered[k - step])}
        barycentre = {}
        for i, node in enumerate(ordered[k]):
            near = [place[start] for start, end in pairs if end == node and start in place]
            barycentre[node] = float(np.mean(near)) if near else float(i)
        ordered[k].sort(key=barycentre.__getitem__)
    return ordered


def place_nodes(graph: Graph, layout: Layout, sizes: dict[str, float]) -> dict[str, float]:
    """Return the position of every node along its layer [inch], near its neighbours and without overlap.

    Parameters
    ----------
    graph : Graph
        The graph.
    layout : Layout
        Its layers.
    sizes : dict of str to float
        Extent of each node along its layer [inch].
    """
    half = {node: sizes.get(node, PLACEHOLDER) / 2 for layer in layout.layers for node in layer}
    position: dict[str, float] = {}
    for layer in layout.layers:
        steps = [half[first] + half[second] + GAP for first, second in pairwise(layer)]
        places = np.cumsum([0.0, *steps])
        position |= zip(layer, (places - places[-1] / 2).tolist(), strict=True)
    redundant = find_redundant_edges(graph)
    near: dict[str, list[str]] = {node: [] for node in position}
    for chain in layout.chains:
        is_required = (chain[0], chain[-1]) not in redundant
        for first, second in pairwise(chain):
            # Required edges should be straight, and so should long edges between their ends.
            weight = STRAIGHT_WEIGHT if is_required or not {first, second} & graph.labels.keys() else 1
            near[first] += [second] * weight
            near[second] += [first] * weight
    for _ in range(ITERATIONS):
        for layer in layout.layers:
            wishes = [float(np.mean([position[m] for m in near[n]])) if near[n] else position[n] for n in layer]
            position |= zip(layer, _separate(wishes, [half[node] for node in layer]), strict=True)
    return position


def _separate(wishes: list[float], half: list[float]) -> list[float]:
    """Return the positions nearest to the wishes (least squares) that keep order and gaps.

    Subtracting the smallest distances turns this into an isotonic regression, solved by pooling adjacent violators.
    """
    shift = np.cumsum([0.0, *(first + second + GAP for first, second in pairwise(half))])
    blocks: list[tuple[float, int]] = []  # mean of wishes less shift, and number of nodes
    for value in np.array(wishes) - shift:
        blocks.append((float(value), 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (a, n), (b, m) = blocks[-2:]
            blocks[-2:] = [((a * n + b * m) / (n + m), n + m)]
    return list(np.repeat([mean for mean, _ in blocks], [count for _, count in blocks]) + shift)


def _arrange(graph: Graph, layout: Layout) -> Drawn:
    """Return positions and sizes: from left to right if that fits the page, else from top to bottom."""
    lines = {node: text.split("\n") for node, text in graph.labels.items()}
    widths = {node: max(map(len, texts)) * LETTER + 0.2 for node, texts in lines.items()}
    heights = {node: BOX + LINE * (len(texts) - 1) for node, texts in lines.items()}
    columns = [max((widths[n] for n in layer if n in widths), default=0.1) for layer in layout.layers]
    is_horizontal = sum(columns) + LAYER_GAP * (len(columns) - 1) <= style.WIDTH - 0.1
    rows = [max(heights[n] for n in layer if n in heights) for layer in layout.layers]
    extents = np.array(columns if is_horizontal else rows)
    middles = np.cumsum([0.0, *(extents[:-1] + LAYER_GAP)]) + extents / 2
    position = place_nodes(graph, layout, heights if is_horizontal else widths)
    places = {}
    for layer, middle in zip(layout.layers, middles, strict=True):
        for node in layer:
            places[node] = (middle, -position[node]) if is_horizontal else (position[node], -middle)
    return Drawn(places, widths, heights, is_horizontal)


def draw_chain(graph: Graph) -> style.Drawing:
    """Draw the flow chart."""
    layout = find_layout(graph)
    drawn = _arrange(graph, layout)
    x = [place[0] + sign * drawn.widths.get(n, 0.0) / 2 for n, place in drawn.places.items() for sign in (-1, 1)]
    y = [place[1] + sign * drawn.heights.get(n, 0.0) / 2 for n, place in drawn.places.items() for sign in (-1, 1)]
    width, height = np.ptp(x) + 0.2, np.ptp(y) + 0.2
    zoom = min(1.0, style.WIDTH / width)
    figure = Figure(figsize=(max(width * zoom, style.WIDTH), height * zoom))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    ax.set_aspect("equal")
    margin = max(0.0, style.WIDTH - width) / 2 + 0.1
    ax.set(xlim=(min(x) - margin, max(x) + margin), ylim=(min(y) - 0.1, max(y) + 0.1))
    redundant = find_redundant_edges(graph)
    for chain in layout.chains:
        _draw_edge(ax, chain, drawn, is_faint=(chain[0], chain[-1]) in redundant)
    starts = {start for start, _ in graph.edges}
    for node, text in graph.labels.items():
        (centre_x, centre_y), box = drawn.places[node], (drawn.widths[node], drawn.heights[node])
        corner = (centre_x - box[0] / 2, centre_y - box[1] / 2)
        shape, face = "round,pad=0,rounding_size=0.07", FACE if node in starts else FINAL_FACE
        ax.add_patch(FancyBboxPatch(corner, *box, shape, facecolor=face, edgecolor=EDGE_COLOUR, zorder=2))
        ax.text(centre_x, centre_y, text, ha="center", va="center", fontsize=FONT_SIZE * zoom, zorder=3)
    caption = (
        f"Flow chart of the workflow with {len(graph.labels)} stages. An arrow leads from each stage to those that read"
        " its output; it is pale if a longer path connects them as well. Final stages have another colour. The paper's"
        " flow chart contains only the simulation; here the simulated frames pass the same stages as the measured ones."
    )
    return style.Drawing(figure, caption)


def _draw_edge(ax: Axes, chain: list[str], drawn: Drawn, is_faint: bool) -> None:
    """Draw a smooth line with an arrow head from the border of the first node to that of the last."""
    colour, width, zorder = ("0.8", 0.8, 0.5) if is_faint else ("0.25", 1.4, 1.0)
    axis, sign, sizes = (0, 1, drawn.widths) if drawn.is_horizontal else (1, -1, drawn.heights)
    points = [np.array(drawn.places[node], float) for node in chain]
    points[0][axis] += sign * sizes[chain[0]] / 2
    points[-1][axis] -= sign * (sizes[chain[-1]] / 2 + ARROW_LENGTH)
    vertices, codes = [points[0]], [Path.MOVETO]
    for start, end in pairwise(points):
        lead = np.zeros(2)
        lead[axis] = (end - start)[axis] / 2
        vertices += [start + lead, end - lead, end]
        codes += [Path.CURVE4] * 3
    path = Path(vertices, codes)
    ax.add_patch(PathPatch(path, facecolor="none", edgecolor=colour, linewidth=width, zorder=zorder))
    tip, back, side = points[-1].copy(), points[-1].copy(), np.zeros(2)
    tip[axis] += sign * ARROW_LENGTH
    # The head overlaps the end of the line.
    back[axis] -= sign * 0.02
    side[1 - axis] = ARROW_HALF_WIDTH
    ax.fill(*np.array([tip, back + side, back - side]).T, color=colour, linewidth=0, zorder=zorder)
