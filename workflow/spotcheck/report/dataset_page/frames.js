// Frames: the picture of the first screen, and one frame at a time beside its models.
// A frame is unpacked when it is shown: base64 → deflate → 16-bit integers → readings in DN (packed.py packs them).

const INDEX = JSON.parse(document.getElementById("frames-index")?.textContent ?? "null");
const MISSING = 65535;
const unpackedFrames = new Map();

/** Readings of a frame by layer: Float32Array of side × side in DN, NaN where none was measured. */
function readingsOf(number) {
  if (!unpackedFrames.has(number)) {
    if (unpackedFrames.size > 8) unpackedFrames.delete(unpackedFrames.keys().next().value);
    unpackedFrames.set(number, unpack(number));
  }
  return unpackedFrames.get(number);
}

async function unpack(number) {
  const text = document.getElementById(`frame-${number}`).textContent;
  const bytes = Uint8Array.from(atob(text), (own) => own.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const whole = new Uint8Array(await new Response(stream).arrayBuffer());
  const frame = INDEX.frames[number], size = INDEX.side ** 2, integers = {}, out = {};
  frame.layers.forEach((name, k) => {
    const low = whole.subarray(2 * k * size, (2 * k + 1) * size), high = whole.subarray((2 * k + 1) * size, (2 * k + 2) * size);
    const own = Uint16Array.from(low, (byte, i) => byte | (high[i] << 8));
    if (INDEX.smooth.includes(name)) for (const _ of [1, 2]) sumRows(own);
    const beside = name.startsWith("without ") ? integers.extended : null;
    if (beside) beside.forEach((value, i) => { own[i] += value; });
    integers[name] = own;
    out[name] = Float32Array.from(own, (value) => (frame.gaps && value === MISSING ? NaN : value * INDEX.steps[name]));
  });
  return out;
}

/** Running sums along each row, which undo differences. */
function sumRows(values) {
  for (let i = 0; i < values.length; i++) if (i % INDEX.side) values[i] += values[i - 1];
}

/** An array of side × side as rows, which Plotly takes. */
function rows(values) {
  return Array.from({ length: INDEX.side }, (_, k) => values.subarray(k * INDEX.side, (k + 1) * INDEX.side));
}

/** Measured less model in DN, or over the sensor's noise at the model's mean. */
function residual(measured, model, overNoise) {
  const [atZero, slope] = INDEX.noise, pixels = INDEX.block ** 2;
  const noise = (mean) => Math.sqrt(Math.max(atZero + slope * mean, 1 / 12) / pixels);
  return measured.map((value, i) => (value - model[i]) / (overNoise ? noise(model[i]) : 1));
}

/** The root mean square of the finite numbers; null where there are none. */
function rmsOf(values) {
  const known = values.filter(Number.isFinite);
  return known.length ? Math.sqrt(known.reduce((sum, own) => sum + own * own, 0) / known.length) : null;
}

/** The value below which a part of the finite numbers lie. */
function quantile(values, part) {
  const known = values.filter(Number.isFinite).sort();
  return known.length ? known[Math.min(Math.floor(part * known.length), known.length - 1)] : 0;
}

/** Middles of the image's rows or columns in px of the sensor. */
function places(corner) {
  return Array.from({ length: INDEX.side }, (_, k) => corner + INDEX.block * (k + 0.5) - 0.5);
}

// What is drawn of a frame: panels with a title, readings in DN, and which of the two scales they are on.

function imagePanel(frame, title, values, scale, extra = {}) {
  return { kind: "image", title, values, scale, x: places(frame.corner[0]), y: places(frame.corner[1]), ...extra };
}

/** Traces and layout of panels in a grid of so many columns. Images share their axes and their scales. */
function figureOf(panels, columns, look) {
  const data = [], layout = { annotations: [], margin: { l: 44, r: 8, t: 22, b: 36 }, showlegend: look.legend ?? false };
  const rowCount = Math.ceil(panels.length / columns), gapX = look.gapX ?? 0.035, gapY = look.gapY ?? 0.1;
  const right = look.bars === false ? 1 : 1 - 78 / look.width;
  const width = (right - gapX * (columns - 1)) / columns, height = (1 - gapY * (rowCount - 1)) / rowCount;
  // Two profiles may share a place of the grid, one over the other.
  const placed = panels.flatMap((own, k) => [own].flat().map((panel, part, all) => ({ panel, k, part, parts: all.length })));
  placed.forEach(({ panel, k, part, parts }, number) => {
    const column = k % columns, row = Math.floor(k / columns), id = number ? String(number + 1) : "";
    const x = [column * (width + gapX), column * (width + gapX) + width];
    const each = (height - (parts - 1) * gapY) / parts, top = 1 - row * (height + gapY) - part * (each + gapY);
    const y = [top - each, top];
    layout.annotations.push({ text: panel.title, x: (x[0] + x[1]) / 2, y: y[1], xref: "paper", yref: "paper",
      xanchor: "center", yanchor: "bottom", showarrow: false, font: { size: 12 } });
    layout[`xaxis${id}`] = { domain: x, anchor: `y${id}`, ...panel.xaxis };
    layout[`yaxis${id}`] = { domain: y, anchor: `x${id}`, ...panel.yaxis };
    if (panel.kind === "image") addImage(data, layout, panel, id, column === 0, row === rowCount - 1 || look.ticks === "all", look);
    else panel.traces.forEach((own) => data.push({ ...own, xaxis: `x${id}`, yaxis: `y${id}` }));
  });
  return { data, layout };
}

function addImage(data, layout, panel, id, first, last, look) {
  const { scale } = panel, log = scale.log;
  // A colour has no logarithm: its numbers do, and the hover shows the reading itself.
  const shown = log ? panel.values.map((value) => Math.log10(Math.max(value, scale.low))) : panel.values;
  data.push({
    type: "heatmap", z: rows(shown), customdata: log ? rows(panel.values) : undefined, x: panel.x, y: panel.y,
    coloraxis: scale.axis, xaxis: `x${id}`, yaxis: `y${id}`, name: panel.title, hoverongaps: false,
    hovertemplate: `row %{y:.0f}, column %{x:.0f}<br>${panel.title}: %{${log ? "customdata" : "z"}:.5~g} ${scale.unit}<extra></extra>`,
  });
  const linked = id && look.linked ? { matches: "x" } : {}, linkedY = id && look.linked ? { matches: "y" } : {};
  // Of images that move together none may shrink alone.
  const constrain = look.linked ? "range" : "domain";
  Object.assign(layout[`xaxis${id}`], linked, { range: look.x, showgrid: false, zeroline: false, constrain,
    showticklabels: last, title: last ? { text: "column / px", standoff: 4 } : undefined, nticks: 4 });
  Object.assign(layout[`yaxis${id}`], linkedY, { range: look.y, showgrid: false, zeroline: false, constrain,
    ...(id && look.linked ? {} : { scaleanchor: `x${id}` }), showticklabels: first, title: first ? { text: "row / px", standoff: 4 } : undefined, nticks: 4 });
  layout[scale.axis] = colourAxis(scale, look);
}

function colourAxis(scale, look) {
  const upper = scale.axis === "coloraxis";
  const bar = { title: { text: scale.title, side: "right" }, x: 1, xanchor: "right", xpad: 0, ypad: 0, thickness: 12,
    len: 0.44, lenmode: "fraction", y: upper ? 1 : 0.44, yanchor: "top" };
  const range = scale.log ? [Math.log10(scale.low), Math.log10(scale.high)] : [scale.low, scale.high];
  if (scale.log) {
    bar.tickvals = [];
    for (let power = Math.ceil(range[0]); power <= range[1]; power++) bar.tickvals.push(power);
    bar.ticktext = bar.tickvals.map((power) => (10 ** power).toLocaleString("en"));
  }
  return { colorscale: COLOURS[scale.colours], cmin: range[0], cmax: range[1], colorbar: bar, showscale: look.bars !== false };
}

/** The scale of readings of some images, from 0 or, in the logarithm, from 1 DN on. */
function readingScale(images, log) {
  const high = Math.max(...images.map((own) => own.reduce((a, b) => (b > a ? b : a), 1)));
  return { axis: "coloraxis", colours: "reading", unit: "DN", title: "reading / DN", log, low: log ? 1 : 0, high };
}

/** The scale of residuals of some images: even on both sides of 0, up to all but 0.5 % of the pixels. */
function residualScale(images, overNoise) {
  const end = Math.max(...images.map((own) => quantile(own.map(Math.abs), 0.995)), 1e-6);
  const unit = overNoise ? "σ" : "DN";
  return { axis: "coloraxis2", colours: "residual", unit, title: `residual / ${overNoise ? "noise σ" : "DN"}`, low: -end, high: end };
}

/** Ranges of columns and rows, in px of the sensor, about the spot: so many of its widths, rows downwards. */
function around(frame, widths) {
  const full = INDEX.side * INDEX.block, [left, top] = frame.corner;
  if (!widths || !frame.sigma) return { x: [left - 0.5, left + full - 0.5], y: [top + full - 0.5, top - 0.5] };
  const half = Math.min(widths * frame.sigma, full / 2), x = left + frame.spot[0], y = top + frame.spot[1];
  return { x: [x - half, x + half], y: [y + half, y - half] };
}

// Widths [px] below which panels stand below each other, and below which all of them do not stand side by side.
const NARROW = 500, MEDIUM = 900;

/** The width of an element [px], on paper that of paper. */
function widthOf(element) {
  return paper ?? element.clientWidth;
}

// The picture of the first screen.

const FIRST_WIDTHS = 3;

async function drawFirst(element) {
  const number = INDEX.best, frame = INDEX.frames[number], all = await readingsOf(number);
  const models = INDEX.pictured;
  const left = models.map((name) => residual(all.measured, all[name], false));
  const reading = readingScale([all.measured, ...models.map((name) => all[name])], false), rest = residualScale(left, false);
  const wide = widthOf(element), narrow = wide < NARROW;
  const titles = models.length > 1 ? { declared: "model before", extended: "model after" } : { declared: "model", simulated: "simulation" };
  const panels = [
    imagePanel(frame, "measured", all.measured, reading),
    ...models.map((name) => imagePanel(frame, titles[name], all[name], reading)),
    ...models.map((name, k) => imagePanel(frame, `${narrow ? "left by" : "measured −"} ${titles[name]}`, left[k], rest)),
  ];
  const columns = narrow ? 2 : wide < MEDIUM ? 3 : panels.length, side = (wide - (narrow ? 0 : 120)) / columns;
  element.style.height = wide < MEDIUM ? `${Math.ceil(panels.length / columns) * (side + 20) + (narrow ? 0 : 60)}px` : "";
  const figure = figureOf(panels, columns, { ...around(frame, FIRST_WIDTHS), linked: true, width: wide, gapX: narrow ? 0.06 : 0.012, gapY: 0.12, bars: !narrow });
  element.dataset.drawn = "yes";
  element.dataset.frame = number;
  // Buttons would lie on the titles, and a double click goes back without them.
  await draw(element, figure.data, figure.layout, { displayModeBar: false });
}

// One frame at a time.

const viewer = document.getElementById("viewer");
const controls = viewer && document.getElementById("viewer-controls");
let shownFrame = INDEX?.best ?? 0;

/** The frame nearest to the places that the controls show, the one that was changed foremost. */
function chosenFrame(changed) {
  const wanted = INDEX.axes.map((axis) => Number(controls.elements[`axis-${axis.name}`].value));
  const miss = (frame) => frame.at.reduce((sum, at, k) =>
    sum + (at !== wanted[k]) * (INDEX.axes[k].name === changed ? 1000 : 1) + Math.abs(at - wanted[k]) * 1e-3, 0);
  return INDEX.frames.reduce((best, frame, k) => (miss(frame) < miss(INDEX.frames[best]) ? k : best), 0);
}

function setControls(frame) {
  INDEX.axes.forEach((axis, k) => { controls.elements[`axis-${axis.name}`].value = frame.at[k]; });
}

function profilePanel(frame, all, names, along, log) {
  const at = Math.min(Math.max(Math.floor((frame.spot[along === "x" ? 1 : 0] + 0.5) / INDEX.block), 0), INDEX.side - 1);
  const line = (values) => Array.from({ length: INDEX.side }, (_, k) => values[along === "x" ? at * INDEX.side + k : k * INDEX.side + at]);
  const looks = { measured: { color: colour("measured"), width: 2.5 }, 0: { color: colour("simulated"), width: 1.5, dash: "dash" },
    1: { color: colour("ink"), width: 1.2, dash: "dot" } };
  const place = places(frame.corner[along === "x" ? 0 : 1]);
  const traces = ["measured", ...names].map((name, k) => ({
    type: "scatter", mode: "lines", x: place, y: line(all[name]).map((v) => (log && v <= 0 ? null : v)),
    name: INDEX.names[name], line: k ? looks[k - 1] : looks.measured, showlegend: along === "x", legendgroup: name,
    hovertemplate: `${INDEX.names[name]}: %{y:.5~g} DN<extra></extra>`,
  }));
  const title = along === "x" ? "column / px" : "row / px";
  return { kind: "profile", title: along === "x" ? "along the centre's row" : "along the centre's column", traces,
    xaxis: { title: { text: title, standoff: 4 }, nticks: 5 },
    yaxis: { title: { text: "reading / DN", standoff: 4 }, type: log ? "log" : "linear", rangemode: "tozero" } };
}

async function drawViewer() {
  const frame = INDEX.frames[shownFrame], all = await readingsOf(shownFrame);
  const read = (name) => controls.elements[name].value, log = read("scale") === "log", overNoise = read("residual") === "noise";
  const names = ["first", "second"].map(read).filter((name) => all[name]);
  const left = names.map((name) => residual(all.measured, all[name], overNoise));
  const reading = readingScale([all.measured, ...names.map((name) => all[name])], log), rest = residualScale(left, overNoise);
  const wide = widthOf(viewer), narrow = wide < NARROW;
  const images = [imagePanel(frame, "measured", all.measured, reading), ...names.map((name) => imagePanel(frame, INDEX.names[name], all[name], reading))];
  const rests = names.map((name, k) => imagePanel(frame, `${narrow ? "left by" : "measured −"} ${INDEX.names[name]}`, left[k], rest));
  const profile = (along) => profilePanel(frame, all, names, along, log);
  const panels = narrow ? [...images, ...rests, profile("x"), profile("y")] : [...images, [profile("x"), profile("y")], ...rests];
  const rowCount = Math.ceil(panels.length / (narrow ? 1 : 3)), side = narrow ? wide - 140 : (wide - 190) / 3;
  viewer.style.height = `${rowCount * (Math.max(side, 120) + 62) + 60}px`;
  const look = { linked: true, ticks: "all", width: wide, gapX: 0.045, gapY: (narrow ? 66 : 72) / viewer.offsetHeight, legend: true };
  const figure = figureOf(panels, narrow ? 1 : 3, { ...look, ...around(frame, Number(read("zoom"))) });
  figure.layout.legend = { orientation: "h", x: 0, y: 0, yanchor: "bottom", yref: "container" };
  figure.layout.margin.b = 64;
  viewer.dataset.drawn = "yes";
  viewer.dataset.frame = shownFrame;
  const known = INDEX.noise[1] !== null;
  const rms = Object.fromEntries(names.map((name) => [name, known ? rmsOf(residual(all.measured, all[name], true)) : null]));
  document.getElementById("viewer-said").replaceChildren(...saidOf(frame, names, rms));
  await draw(viewer, figure.data, figure.layout);
}

/** What is said of a frame, as words and marked numbers; `rms` are those of the models that are drawn. */
function saidOf(frame, names, rms) {
  const left = names.filter((name) => frame.left[name] != null || rms[name] != null);
  const said = left.flatMap((name, k) => {
    const told = frame.left[name] != null ? marked(frame.left[name], `views.${name}_left[frame=${frame.file}]`) : noiseText(rms[name]);
    return [k ? ", " : " Left, rms: ", told, ` by the ${INDEX.names[name]}`];
  });
  return [`${frame.label} (${frame.file}).`, ...said, left.length ? "." : "",
    frame.why ? ` Why: ${frame.why}.` : "", names.length ? "" : " No model could be evaluated for this frame."];
}

/** A number in units of the noise. */
function noiseText(value) {
  return `${Number(value.toPrecision(3))} noise σ`;
}

/** A number in units of the noise that says where it comes from, as those of cited.py do. */
function marked(value, key) {
  const own = document.createElement("span");
  own.className = "from";
  own.dataset.key = key;
  own.title = `views.nc: ${key.split(/[.[]/)[1]}; explain: spotcheck explain '${key}'`;
  own.textContent = noiseText(value);
  return own;
}

/** Shows a frame in the viewer. */
function showFrame(number) {
  shownFrame = number;
  setControls(INDEX.frames[number]);
  return drawViewer();
}

function openFrame(row) {
  location.hash = "#frames";
  openTarget();
  showFrame(Number(row.dataset.frame));
}

if (INDEX) {
  drawInView([document.getElementById("first-picture")], drawFirst);
  drawInView([viewer], () => showFrame(shownFrame));
  controls.addEventListener("change", (event) => {
    const axis = event.target.name.startsWith("axis-") && event.target.name.slice(5);
    if (axis) showFrame(chosenFrame(axis)); else drawViewer();
  });
  document.querySelectorAll("tr[data-frame]").forEach((row) => row.addEventListener("click", () => openFrame(row)));
  const first = document.getElementById("first-picture");
  // A frame that is shown is unpacked: it is drawn before the sheet is laid out.
  const anew = () => [[viewer, drawViewer], [first, () => drawFirst(first)]].forEach(([own, again]) => own.dataset.drawn && again());
  for (const end of [NARROW, MEDIUM]) matchMedia(`(max-width: ${end + 30}px)`).addEventListener("change", anew);
  addEventListener("beforeprint", anew);
  addEventListener("afterprint", anew);
}
