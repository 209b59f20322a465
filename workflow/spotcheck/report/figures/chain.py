"""Flow chart of the workflow (Fig. 6 of the paper), drawn from the output of `snakemake --rulegraph`.

The layout follows K. Sugiyama, S. Tagawa and M. Toda (IEEE Trans. Syst. Man Cybern. 11, 109, 1981): nodes are placed in
layers, each layer is ordered by barycentres, and coordinates follow by least squares. A node is a rule. A placeholder
stands for an edge in each layer that the edge crosses, so that a link connects neighbouring layers only.
"""

import re
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, PathPatch
from matplotlib.path import Path

from spotcheck.errors import InputError
from spotcheck.report.figures import style

# Lines of dot text: a node with its label, and an edge.
NODE = re.compile(r'^\s*"?(\w+)"?\s*\[.*?label\s*=\s*"([^"]*)"')
EDGE = re.compile(r'^\s*"?(\w+)"?\s*->\s*"?(\w+)"?')
# Sweeps that order the layers, and iterations that position the nodes along them.
SWEEPS, ITERATIONS = 24, 300
# Weight of links that should be straight, relative to other links.
STRAIGHT_WEIGHT = 8
# Width of a letter, horizontal padding of a box, height of a box with one line and of each further line [inch].
LETTER, PADDING, BOX, LINE = 0.075, 0.2, 0.27, 0.15
# Gap between boxes, gap between layers, extent of a placeholder, and margin of the drawing [inch].
GAP, LAYER_GAP, PLACEHOLDER, MARGIN = 0.16, 0.30, 0.06, 0.1
# Length of an arrow head, half its width, and its overlap with the line [inch].
ARROW_LENGTH, ARROW_HALF_WIDTH, ARROW_OVERLAP = 0.06, 0.035, 0.02
FONT_SIZE = 9.0
# Colour of boxes, of their borders, and of the boxes of final stages.
FACE, BORDER, FINAL_FACE = "#e4eef6", "#0072B2", "#fdebd8"

Edge = tuple[str, str]  # id of a rule, and id of a rule that reads its output


class Graph(NamedTuple):
    """Rules and their dependencies."""

    labels: dict[str, str]  # label of each node by its id, "\n" between lines
    edges: list[Edge]  # dependencies


class Layout(NamedTuple):
    """Layers of a graph."""

    layers: list[list[str]]  # ids of the nodes and placeholders of each layer, in their order
    chains: list[list[str]]  # each edge as a path with one placeholder per layer that it crosses


class Arrangement(NamedTuple):
    """Positions and sizes in the drawing [inch]; x points right, y up."""

    centres: dict[str, tuple[float, float]]  # centre (x, y) of each node and placeholder, by its id
    widths: dict[str, float]  # width of the box of each node, by its id
    heights: dict[str, float]  # height of the box of each node, by its id
    is_horizontal: bool  # whether layers are columns, from left to right; else rows, from top to bottom


def parse_graph(dot: str) -> Graph:
    """Return the nodes and edges of a graph in dot text, without repeated edges; other lines are ignored.

    Both are sorted by label, since the order of Snakemake's output differs between processes and the drawing must not
    depend on it. Raises `InputError` if there is no node or if the edges form a circle.
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
    edges.sort(key=lambda edge: (order.index(edge[0]), order.index(edge[1])))
    graph = Graph({node: labels[node] for node in order}, edges)
    find_depths(graph)  # raises if there is a circle
    return graph


def find_depths(graph: Graph) -> dict[str, int]:
    """Return the layer of each node, the length of the longest path to it. Raises `InputError` for a circle."""
    predecessors = {node: {start for start, end in graph.edges if end == node} for node in graph.labels}
    depth: dict[str, int] = {}
    try:
        for node in TopologicalSorter(predecessors).static_order():
            depth[node] = max((depth[start] + 1 for start in predecessors[node]), default=0)
    except CycleError:
        raise InputError("the rule graph runs in a circle; the rules must form a chain") from None
    return depth


def find_redundant_edges(graph: Graph) -> set[Edge]:
    """Return the edges whose end can also be reached from their start over other nodes."""
    depth = find_depths(graph)
    successors = {node: {end for start, end in graph.edges if start == node} for node in graph.labels}
    reachable: dict[str, set[str]] = {}
    # From the last layer to the first, so that what each successor reaches is known.
    for node in sorted(graph.labels, key=lambda node: -depth[node]):
        reachable[node] = successors[node].union(*(reachable[successor] for successor in successors[node]))
    return {(start, end) for start, end in graph.edges if any(end in reachable[via] for via in successors[start])}


def find_layout(graph: Graph) -> Layout:
    """Return the layers of a graph: of all sweeps that order nodes by barycentres, the one with fewest crossings."""
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
    best_layers, fewest = layers, count_crossings(layers, links)
    for sweep in range(SWEEPS):
        layers = _order_layers(layers, links, is_forward=sweep % 2 == 0)
        count = count_crossings(layers, links)
        if count < fewest:
            best_layers, fewest = layers, count
    return Layout(best_layers, chains)


def count_crossings(layers: list[list[str]], links: list[Edge]) -> int:
    """Return the number of crossings of `links`, pairs of ids in neighbouring layers."""
    rank = {node: k for layer in layers for k, node in enumerate(layer)}
    depth = {node: k for k, layer in enumerate(layers) for node in layer}
    total = 0
    for k in range(len(layers) - 1):
        ends = [(rank[start], rank[end]) for start, end in links if depth[start] == k]
        # Two links cross if their starts and their ends are in opposite orders.
        total += sum((a - c) * (b - d) < 0 for i, (a, b) in enumerate(ends) for c, d in ends[:i])
    return total


def _order_layers(layers: list[list[str]], links: list[Edge], is_forward: bool) -> list[list[str]]:
    """Return the layers, each ordered by the mean rank (barycentre) of the neighbours of its nodes.

    Neighbours are those in the previous layer if `is_forward`, else those in the next layer. A node without neighbours
    counts with its present rank.
    """
    ordered = [list(layer) for layer in layers]
    step = 1 if is_forward else -1
    # Pairs of a node in the layer that is already ordered and a node in the layer to order.
    pairs = links if is_forward else [(end, start) for start, end in links]
    for k in range(1, len(layers)) if is_forward else range(len(layers) - 2, -1, -1):
        rank = {node: i for i, node in enumerate(ordered[k - step])}
        barycentre = {}
        for i, node in enumerate(ordered[k]):
            neighbour_ranks = [rank[start] for start, end in pairs if end == node and start in rank]
            barycentre[node] = float(np.mean(neighbour_ranks)) if neighbour_ranks else float(i)
        ordered[k].sort(key=barycentre.__getitem__)
    return ordered


def place_nodes(graph: Graph, layout: Layout, sizes: dict[str, float]) -> dict[str, float]:
    """Return the position of each node and placeholder along its layer, near its neighbours and without overlap.

    Parameters
    ----------
    graph : Graph
        The graph.
    layout : Layout
        Its layers.
    sizes : dict of str to float
        Extent of each node along its layer, by its id [inch].

    Returns
    -------
    dict of str to float
        Coordinate of the centre along the layer, by id [inch].
    """
    half_sizes = {node: sizes.get(node, PLACEHOLDER) / 2 for layer in layout.layers for node in layer}
    position: dict[str, float] = {}
    # Start with centred layers without spare room.
    for layer in layout.layers:
        offsets = _closest_offsets([half_sizes[node] for node in layer])
        position |= zip(layer, (offsets - offsets[-1] / 2).tolist(), strict=True)
    redundant = find_redundant_edges(graph)
    # Neighbours of each node, repeated by the weight of the link.
    neighbours: dict[str, list[str]] = {node: [] for node in position}
    for chain in layout.chains:
        is_required = (chain[0], chain[-1]) not in redundant
        for first, second in pairwise(chain):
            # Required edges should be straight, and so should long edges between their ends.
            weight = STRAIGHT_WEIGHT if is_required or not {first, second} & graph.labels.keys() else 1
            neighbours[first] += [second] * weight
            neighbours[second] += [first] * weight
    for _ in range(ITERATIONS):
        for layer in layout.layers:
            # A node without neighbours stays.
            targets = [float(np.mean([position[node] for node in neighbours[n] or [n]])) for n in layer]
            position |= zip(layer, _separate(targets, [half_sizes[node] for node in layer]), strict=True)
    return position


def _closest_offsets(half_sizes: list[float]) -> np.ndarray:
    """Return the distance of each node of a layer from the first one [inch] if there is only `GAP` between boxes."""
    return np.cumsum([0.0, *(first + second + GAP for first, second in pairwise(half_sizes))])


def _separate(targets: list[float], half_sizes: list[float]) -> list[float]:
    """Return the positions [inch] nearest to the targets (least squares) that keep the order and do not overlap.

    Subtracting the closest offsets turns this into an isotonic regression, solved by pooling adjacent violators.
    """
    offsets = _closest_offsets(half_sizes)
    blocks: list[tuple[float, int]] = []  # mean of the targets less offsets, and number of nodes
    for value in np.array(targets) - offsets:
        blocks.append((float(value), 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (first, first_count), (second, second_count) = blocks[-2:]
            count = first_count + second_count
            blocks[-2:] = [((first * first_count + second * second_count) / count, count)]
    return list(np.repeat([mean for mean, _ in blocks], [count for _, count in blocks]) + offsets)


def _arrange(graph: Graph, layout: Layout) -> Arrangement:
    """Return positions and sizes; the layers run from left to right if that fits the page, else from top to bottom."""
    lines = {node: text.split("\n") for node, text in graph.labels.items()}
    widths = {node: max(map(len, texts)) * LETTER + PADDING for node, texts in lines.items()}
    heights = {node: BOX + LINE * (len(texts) - 1) for node, texts in lines.items()}
    # Extent of each layer across it; each has at least one node.
    columns, rows = (
        [max(sizes[node] for node in layer if node in sizes) for layer in layout.layers] for sizes in (widths, heights)
    )
    is_horizontal = sum(columns) + LAYER_GAP * (len(columns) - 1) <= style.WIDTH - MARGIN
    extents = np.array(columns if is_horizontal else rows)
    middles = np.cumsum([0.0, *(extents[:-1] + LAYER_GAP)]) + extents / 2
    position = place_nodes(graph, layout, heights if is_horizontal else widths)
    centres = {}
    for layer, middle in zip(layout.layers, middles, strict=True):
        for node in layer:
            centres[node] = (middle, -position[node]) if is_horizontal else (position[node], -middle)
    return Arrangement(centres, widths, heights, is_horizontal)


def draw_chain(graph: Graph) -> style.Drawing:
    """Draw the flow chart of a graph; a chart that is wider than the page is scaled down."""
    layout = find_layout(graph)
    arrangement = _arrange(graph, layout)
    centres, widths, heights, _ = arrangement
    # Edges of all boxes; a placeholder has no extent.
    x = [centre[0] + sign * widths.get(node, 0.0) / 2 for node, centre in centres.items() for sign in (-1, 1)]
    y = [centre[1] + sign * heights.get(node, 0.0) / 2 for node, centre in centres.items() for sign in (-1, 1)]
    width, height = np.ptp(x) + 2 * MARGIN, np.ptp(y) + 2 * MARGIN
    zoom = min(1.0, style.WIDTH / width)
    figure = Figure(figsize=(max(width * zoom, style.WIDTH), height * zoom))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    ax.set_aspect("equal")
    side_margin = max(0.0, style.WIDTH - width) / 2 + MARGIN
    ax.set(xlim=(min(x) - side_margin, max(x) + side_margin), ylim=(min(y) - MARGIN, max(y) + MARGIN))
    redundant = find_redundant_edges(graph)
    for chain in layout.chains:
        _draw_edge(ax, chain, arrangement, is_faint=(chain[0], chain[-1]) in redundant)
    starts = {start for start, _ in graph.edges}
    for node, text in graph.labels.items():
        (centre_x, centre_y), box_width, box_height = centres[node], widths[node], heights[node]
        corner = (centre_x - box_width / 2, centre_y - box_height / 2)
        shape, face = "round,pad=0,rounding_size=0.07", FACE if node in starts else FINAL_FACE
        box = FancyBboxPatch(corner, box_width, box_height, shape, facecolor=face, edgecolor=BORDER, zorder=2)
        ax.add_patch(box)
        ax.text(centre_x, centre_y, text, ha="center", va="center", fontsize=FONT_SIZE * zoom, zorder=3)
    caption = (
        f"Flow chart of the workflow with {len(graph.labels)} stages. An arrow leads from each stage to those that read"
        " its output; it is pale if a longer path connects them as well. Final stages have another colour. The paper's"
        " flow chart contains only the simulation; here the simulated frames pass the same stages as the measured ones."
    )
    return style.Drawing(figure, caption)


def _draw_edge(ax: Axes, chain: list[str], arrangement: Arrangement, is_faint: bool) -> None:
    """Draw an edge along its chain of ids, as a smooth line from box to box with an arrow head at the last one."""
    colour, width, zorder = ("0.8", 0.8, 0.5) if is_faint else ("0.25", 1.4, 1.0)
    # Coordinate across the layers, its sign along the arrow, and the extents of boxes in it.
    axis, sign, sizes = (0, 1, arrangement.widths) if arrangement.is_horizontal else (1, -1, arrangement.heights)
    points = [np.array(arrangement.centres[node], float) for node in chain]
    points[0][axis] += sign * sizes[chain[0]] / 2
    points[-1][axis] -= sign * (sizes[chain[-1]] / 2 + ARROW_LENGTH)
    vertices, codes = [points[0]], [Path.MOVETO]
    for start, end in pairwise(points):
        # Control points of a Bézier curve that crosses each layer at a right angle.
        lead = np.zeros(2)
        lead[axis] = (end - start)[axis] / 2
        vertices += [start + lead, end - lead, end]
        codes += [Path.CURVE4] * 3
    line = Path(vertices, codes)
    ax.add_patch(PathPatch(line, facecolor="none", edgecolor=colour, linewidth=width, zorder=zorder))
    tip, base, half_base = points[-1].copy(), points[-1].copy(), np.zeros(2)
    tip[axis] += sign * ARROW_LENGTH
    base[axis] -= sign * ARROW_OVERLAP
    half_base[1 - axis] = ARROW_HALF_WIDTH
    ax.fill(*np.array([tip, base + half_base, base - half_base]).T, color=colour, linewidth=0, zorder=zorder)
