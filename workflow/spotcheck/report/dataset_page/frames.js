// Images of frames: the picture of the first screen, and the viewer of one frame beside its models.
// A frame is unpacked to show it: base64 → deflate → 16-bit integers → readings in DN (frame_packing.py packs them).

const INDEX = JSON.parse(document.getElementById("frames-index")?.textContent ?? "null");
const MISSING = 65535, MOST_UNPACKED = 8;
const unpackedFrames = new Map();

/** Returns a promise of the readings of a frame by layer: Float32Array of side × side in DN, NaN where not measured. */
function readFrame(number) {
  if (!unpackedFrames.has(number)) {
    if (unpackedFrames.size > MOST_UNPACKED) unpackedFrames.delete(unpackedFrames.keys().next().value);
    unpackedFrames.set(number, unpackFrame(number));
  }
  return unpackedFrames.get(number);
}

async function unpackFrame(number) {
  const text = document.getElementById(`frame-${number}`).textContent;
  const compressed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([compressed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const frame = INDEX.frames[number], size = INDEX.side ** 2, integers = {}, readings = {};
  frame.layers.forEach((name, k) => {
    const low = bytes.subarray(2 * k * size, (2 * k + 1) * size), high = bytes.subarray((2 * k + 1) * size, (2 * k + 2) * size);
    const values = Uint16Array.from(low, (byte, i) => byte | (high[i] << 8));
    if (INDEX.smooth.includes(name)) for (const _ of [1, 2]) sumRows(values);
    const base = name.startsWith("without ") ? integers.extended : null;
    if (base) base.forEach((value, i) => { values[i] += value; });
    integers[name] = values;
    readings[name] = Float32Array.from(values, (value) => (frame.has_gaps && value === MISSING ? NaN : value * INDEX.steps[name]));
  });
  return readings;
}

/** Replaces the values of each row by their running sums, which inverts differences. */
function sumRows(values) {
  for (let i = 0; i < values.length; i++) if (i % INDEX.side) values[i] += values[i - 1];
}

/** Splits an array of side × side into rows, as Plotly takes them. */
function splitRows(values) {
  return Array.from({ length: INDEX.side }, (_, k) => values.subarray(k * INDEX.side, (k + 1) * INDEX.side));
}

/** Returns measured minus model in DN, or over the sensor's noise at the model's mean. */
function subtract(measured, model, overNoise) {
  const [atZero, slope] = INDEX.noise, pixels = INDEX.block ** 2;
  const noise = (mean) => Math.sqrt(Math.max(atZero + slope * mean, 1 / 12) / pixels);
  return measured.map((value, i) => (value - model[i]) / (overNoise ? noise(model[i]) : 1));
}

/** Returns the root mean square of the finite numbers; null if there are none. */
function rootMeanSquare(values) {
  const known = values.filter(Number.isFinite);
  return known.length ? Math.sqrt(known.reduce((sum, value) => sum + value * value, 0) / known.length) : null;
}

/** Returns the quantile of the finite numbers at a probability; 0 if there are none. */
function quantile(values, probability) {
  const known = values.filter(Number.isFinite).sort();
  return known.length ? known[Math.min(Math.floor(probability * known.length), known.length - 1)] : 0;
}

/** Returns the centres of an image's rows or columns [px of the sensor]; `corner` is the first pixel of the crop. */
function pixelCentres(corner) {
  return Array.from({ length: INDEX.side }, (_, k) => corner + INDEX.block * (k + 0.5) - 0.5);
}

// Panels: images with a title, values and a colour scale, and profiles with traces and axes.

function imagePanel(frame, title, values, scale) {
  return { kind: "image", title, values, scale, x: pixelCentres(frame.corner[0]), y: pixelCentres(frame.corner[1]) };
}

/** Returns traces and layout of panels in a grid. `options` are the width, gaps and ranges; images share their scales. */
function arrangePanels(panels, columns, options) {
  const data = [], layout = { annotations: [], margin: { l: 44, r: 8, t: 22, b: 36 }, showlegend: options.legend ?? false };
  const rowCount = Math.ceil(panels.length / columns), gapX = options.gapX ?? 0.035, gapY = options.gapY ?? 0.1;
  const right = options.bars === false ? 1 : 1 - 78 / options.width;
  const width = (right - gapX * (columns - 1)) / columns, height = (1 - gapY * (rowCount - 1)) / rowCount;
  // A cell of the grid may have two profiles, one above the other.
  const placed = panels.flatMap((cell, k) => [cell].flat().map((panel, part, stack) => ({ panel, k, part, parts: stack.length })));
  placed.forEach(({ panel, k, part, parts }, number) => {
    const column = k % columns, row = Math.floor(k / columns), id = number ? String(number + 1) : "";
    const x = [column * (width + gapX), column * (width + gapX) + width];
    const partHeight = (height - (parts - 1) * gapY) / parts, top = 1 - row * (height + gapY) - part * (partHeight + gapY);
    const y = [top - partHeight, top];
    layout.annotations.push({ text: panel.title, x: (x[0] + x[1]) / 2, y: y[1], xref: "paper", yref: "paper",
      xanchor: "center", yanchor: "bottom", showarrow: false, font: { size: 12 } });
    layout[`xaxis${id}`] = { domain: x, anchor: `y${id}`, ...panel.xaxis };
    layout[`yaxis${id}`] = { domain: y, anchor: `x${id}`, ...panel.yaxis };
    if (panel.kind === "image") addImage(data, layout, panel, id, column === 0, row === rowCount - 1 || options.ticks === "all", options);
    else panel.traces.forEach((trace) => data.push({ ...trace, xaxis: `x${id}`, yaxis: `y${id}` }));
  });
  return { data, layout };
}

/** Adds an image to traces and layout; `id` is the number of its axes, `hasRows` and `hasColumns` whether they have labels. */
function addImage(data, layout, panel, id, hasRows, hasColumns, options) {
  const { scale } = panel, log = scale.log;
  // Plotly has no logarithmic colour scale: logarithms are drawn, and the hover text has the readings.
  const shown = log ? panel.values.map((value) => Math.log10(Math.max(value, scale.low))) : panel.values;
  data.push({
    type: "heatmap", z: splitRows(shown), customdata: log ? splitRows(panel.values) : undefined, x: panel.x, y: panel.y,
    coloraxis: scale.axis, xaxis: `x${id}`, yaxis: `y${id}`, name: panel.title, hoverongaps: false,
    hovertemplate: `row %{y:.0f}, column %{x:.0f}<br>${panel.title}: %{${log ? "customdata" : "z"}:.5~g} ${scale.unit}<extra></extra>`,
  });
  const isFollower = id && options.linked;
  // Linked images must keep equal sizes.
  const constrain = options.linked ? "range" : "domain";
  Object.assign(layout[`xaxis${id}`], isFollower ? { matches: "x" } : {}, { range: options.x, showgrid: false, zeroline: false, constrain,
    showticklabels: hasColumns, title: hasColumns ? { text: "column / px", standoff: 4 } : undefined, nticks: 4 });
  Object.assign(layout[`yaxis${id}`], isFollower ? { matches: "y" } : {}, { range: options.y, showgrid: false, zeroline: false, constrain,
    ...(isFollower ? {} : { scaleanchor: `x${id}` }), showticklabels: hasRows, title: hasRows ? { text: "row / px", standoff: 4 } : undefined, nticks: 4 });
  layout[scale.axis] = colourAxis(scale, options);
}

/** Returns a colour axis with its bar: that of readings is above that of residuals. */
function colourAxis(scale, options) {
  const isUpper = scale.axis === "coloraxis";
  const bar = { title: { text: scale.title, side: "right" }, x: 1, xanchor: "right", xpad: 0, ypad: 0, thickness: 12,
    len: 0.44, lenmode: "fraction", y: isUpper ? 1 : 0.44, yanchor: "top" };
  const range = scale.log ? [Math.log10(scale.low), Math.log10(scale.high)] : [scale.low, scale.high];
  if (scale.log) {
    bar.tickvals = [];
    for (let power = Math.ceil(range[0]); power <= range[1]; power++) bar.tickvals.push(power);
    bar.ticktext = bar.tickvals.map((power) => (10 ** power).toLocaleString("en"));
  }
  return { colorscale: COLOURS[scale.colours], cmin: range[0], cmax: range[1], colorbar: bar, showscale: options.bars !== false };
}

/** Returns the colour scale of readings of images; it begins at 0 DN, or at 1 DN if it is logarithmic. */
function readingScale(images, log) {
  const high = Math.max(...images.map((image) => image.reduce((a, b) => (b > a ? b : a), 1)));
  return { axis: "coloraxis", colours: "reading", unit: "DN", title: "reading / DN", log, low: log ? 1 : 0, high };
}

/** Returns the colour scale of residuals of images: symmetric, up to the 99.5 % quantile of their sizes. */
function residualScale(images, overNoise) {
  const end = Math.max(...images.map((image) => quantile(image.map(Math.abs), 0.995)), 1e-6);
  const unit = overNoise ? "σ" : "DN";
  return { axis: "coloraxis2", colours: "residual", unit, title: `residual / ${overNoise ? "noise σ" : "DN"}`, low: -end, high: end };
}

/** Returns ranges of columns and rows [px of the sensor] within a number of widths of the spot; 0: the whole crop. */
function regionAround(frame, widths) {
  const full = INDEX.side * INDEX.block, [left, top] = frame.corner;
  if (!widths || !frame.sigma) return { x: [left - 0.5, left + full - 0.5], y: [top + full - 0.5, top - 0.5] };
  const half = Math.min(widths * frame.sigma, full / 2), x = left + frame.spot[0], y = top + frame.spot[1];
  return { x: [x - half, x + half], y: [y + half, y - half] };
}

// Widths [px] below which all panels are stacked, and below which they take more than one row.
const NARROW = 500, MEDIUM = 900;

/** Returns the width of an element [px]; in print, that of the paper. */
function availableWidth(element) {
  return paper ?? element.clientWidth;
}

// The picture of the first screen.

// Half of the region that it shows [widths of the spot].
const FIRST_WIDTHS = 3;

async function drawFirst(element) {
  const number = INDEX.first_frame, frame = INDEX.frames[number], readings = await readFrame(number);
  const models = INDEX.first_models, residuals = models.map((name) => subtract(readings.measured, readings[name], false));
  const scale = readingScale([readings.measured, ...models.map((name) => readings[name])], false);
  const scaleOfResiduals = residualScale(residuals, false);
  const width = availableWidth(element), isNarrow = width < NARROW;
  const titles = models.length > 1 ? { declared: "model before", extended: "model after" } : { declared: "model", simulated: "simulation" };
  const panels = [
    imagePanel(frame, "measured", readings.measured, scale),
    ...models.map((name) => imagePanel(frame, titles[name], readings[name], scale)),
    ...models.map((name, k) => imagePanel(frame, residualTitle(titles[name], isNarrow), residuals[k], scaleOfResiduals)),
  ];
  const columns = isNarrow ? 2 : width < MEDIUM ? 3 : panels.length, side = (width - (isNarrow ? 0 : 120)) / columns;
  element.style.height = width < MEDIUM ? `${Math.ceil(panels.length / columns) * (side + 20) + (isNarrow ? 0 : 60)}px` : "";
  const options = { ...regionAround(frame, FIRST_WIDTHS), linked: true, width, gapX: isNarrow ? 0.06 : 0.012, gapY: 0.12, bars: !isNarrow };
  const figure = arrangePanels(panels, columns, options);
  element.dataset.drawn = "yes";
  element.dataset.frame = number;
  // Buttons would cover the titles; a double click resets the region without them.
  await draw(element, figure.data, figure.layout, { displayModeBar: false });
}

/** Returns the title of residuals, which is short in a narrow window. */
function residualTitle(model, isNarrow) {
  return `${isNarrow ? "residual:" : "measured −"} ${model}`;
}

// The viewer of one frame.

const viewer = document.getElementById("viewer");
const controls = viewer && document.getElementById("viewer-controls");
let shownFrame = INDEX?.first_frame ?? 0;

/** Returns the frame nearest to the values of the controls; the control that was changed has priority. */
function selectFrame(changed) {
  const wanted = INDEX.axes.map((axis) => Number(controls.elements[`axis-${axis.name}`].value));
  const distance = (frame) => frame.at.reduce((sum, at, k) =>
    sum + (at !== wanted[k]) * (INDEX.axes[k].name === changed ? 1000 : 1) + Math.abs(at - wanted[k]) * 1e-3, 0);
  return INDEX.frames.reduce((nearest, frame, k) => (distance(frame) < distance(INDEX.frames[nearest]) ? k : nearest), 0);
}

function setControls(frame) {
  INDEX.axes.forEach((axis, k) => { controls.elements[`axis-${axis.name}`].value = frame.at[k]; });
}

/** Returns the panel of profiles through the spot's centre, along its row ("x") or its column ("y"). */
function profilePanel(frame, readings, models, along, log) {
  const at = Math.min(Math.max(Math.floor((frame.spot[along === "x" ? 1 : 0] + 0.5) / INDEX.block), 0), INDEX.side - 1);
  const line = (values) => Array.from({ length: INDEX.side }, (_, k) => values[along === "x" ? at * INDEX.side + k : k * INDEX.side + at]);
  const styles = [{ color: colour("measured"), width: 2.5 }, { color: colour("simulated"), width: 1.5, dash: "dash" },
    { color: colour("ink"), width: 1.2, dash: "dot" }];
  const centres = pixelCentres(frame.corner[along === "x" ? 0 : 1]);
  const traces = ["measured", ...models].map((name, k) => ({
    type: "scatter", mode: "lines", x: centres, y: line(readings[name]).map((value) => (log && value <= 0 ? null : value)),
    name: INDEX.names[name], line: styles[k], showlegend: along === "x", legendgroup: name,
    hovertemplate: `${INDEX.names[name]}: %{y:.5~g} DN<extra></extra>`,
  }));
  const title = along === "x" ? "column / px" : "row / px";
  return { kind: "profile", title: along === "x" ? "along the centre's row" : "along the centre's column", traces,
    xaxis: { title: { text: title, standoff: 4 }, nticks: 5 },
    yaxis: { title: { text: "reading / DN", standoff: 4 }, type: log ? "log" : "linear", rangemode: "tozero" } };
}

async function drawViewer() {
  const frame = INDEX.frames[shownFrame], readings = await readFrame(shownFrame);
  const selected = (name) => controls.elements[name].value;
  const log = selected("scale") === "log", overNoise = selected("residual") === "noise";
  const models = ["first", "second"].map(selected).filter((name) => readings[name]);
  const residuals = models.map((name) => subtract(readings.measured, readings[name], overNoise));
  const scale = readingScale([readings.measured, ...models.map((name) => readings[name])], log);
  const scaleOfResiduals = residualScale(residuals, overNoise);
  const width = availableWidth(viewer), isNarrow = width < NARROW;
  const imagePanels = ["measured", ...models].map((name) => imagePanel(frame, INDEX.names[name], readings[name], scale));
  const residualPanels = models.map((name, k) => imagePanel(frame, residualTitle(INDEX.names[name], isNarrow), residuals[k], scaleOfResiduals));
  const profiles = ["x", "y"].map((along) => profilePanel(frame, readings, models, along, log));
  const panels = isNarrow ? [...imagePanels, ...residualPanels, ...profiles] : [...imagePanels, profiles, ...residualPanels];
  const columns = isNarrow ? 1 : 3, side = isNarrow ? width - 140 : (width - 190) / 3;
  viewer.style.height = `${Math.ceil(panels.length / columns) * (Math.max(side, 120) + 62) + 60}px`;
  const options = { linked: true, ticks: "all", width, gapX: 0.045, gapY: (isNarrow ? 66 : 72) / viewer.offsetHeight, legend: true };
  const figure = arrangePanels(panels, columns, { ...options, ...regionAround(frame, Number(selected("zoom"))) });
  figure.layout.legend = { orientation: "h", x: 0, y: 0, yanchor: "bottom", yref: "container" };
  figure.layout.margin.b = 64;
  viewer.dataset.drawn = "yes";
  viewer.dataset.frame = shownFrame;
  document.getElementById("viewer-caption").replaceChildren(...describeFrame(frame, models, readings));
  await draw(viewer, figure.data, figure.layout);
}

/** Returns texts and marked numbers about a frame: its residuals by the models that are drawn, and remarks. */
function describeFrame(frame, models, readings) {
  const residualOf = (name) => {
    if (frame.over_noise[name] != null) {
      return markNumber(frame.over_noise[name], `views.${name}_left[frame=${frame.file}]`);
    }
    const rms = INDEX.noise[1] === null ? null : rootMeanSquare(subtract(readings.measured, readings[name], true));
    return rms === null ? null : noiseText(rms);
  };
  const parts = models.map((name) => [name, residualOf(name)]).filter(([, residual]) => residual !== null)
    .flatMap(([name, residual], k) => [k ? ", " : " Residual, rms: ", residual, ` by the ${INDEX.names[name]}`]);
  return [`${frame.label} (${frame.file}).`, ...parts, parts.length ? "." : "",
    frame.remarks ? ` Remarks: ${frame.remarks}.` : "", models.length ? "" : " No model could be evaluated for this frame."];
}

function noiseText(value) {
  return `${Number(value.toPrecision(3))} noise σ`;
}

/** Returns an element with a number in units of the noise and its source, as those of citations.py. */
function markNumber(value, key) {
  const element = document.createElement("span");
  element.className = "from";
  element.dataset.key = key;
  element.title = `views.nc: ${key.split(/[.[]/)[1]}; explain: spotcheck explain '${key}'`;
  element.textContent = noiseText(value);
  return element;
}

function showFrame(number) {
  shownFrame = number;
  setControls(INDEX.frames[number]);
  return drawViewer();
}

/** Opens the viewer at the frame of a row of the table. */
function openFrame(row) {
  location.hash = "#frames";
  openTarget();
  showFrame(Number(row.dataset.frame));
}

if (INDEX) {
  const first = document.getElementById("first-picture");
  drawInView([first], drawFirst);
  drawInView([viewer], () => showFrame(shownFrame));
  controls.addEventListener("change", (event) => {
    const axis = event.target.name.startsWith("axis-") && event.target.name.slice(5);
    if (axis) showFrame(selectFrame(axis)); else drawViewer();
  });
  document.querySelectorAll("tr[data-frame]").forEach((row) => row.addEventListener("click", () => openFrame(row)));
  // Frames that are shown are unpacked, so that they are drawn before a sheet of paper is laid out.
  const redraw = () => {
    if (viewer.dataset.drawn) drawViewer();
    if (first.dataset.drawn) drawFirst(first);
  };
  for (const end of [NARROW, MEDIUM]) matchMedia(`(max-width: ${end + 30}px)`).addEventListener("change", redraw);
  addEventListener("beforeprint", redraw);
  addEventListener("afterprint", redraw);
}
