// What every page with plots shares: Plotly in the page's own colours, figures that are drawn when they come into view,
// folds that open where a link leads, tables that sort.
"use strict";

// What changes the page's colours: a dark ground, and paper.
const GROUNDS = [matchMedia("(prefers-color-scheme: dark)"), matchMedia("print")];
const CONFIG = { responsive: true, displaylogo: false, displayModeBar: innerWidth < 500 ? false : "hover", modeBarButtonsToRemove: ["select2d", "lasso2d", "toImage"] };

/** A colour of the page by its name in page.css. */
function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Plotly's template in the page's colours. */
function template() {
  const ink = colour("ink"), rule = colour("rule");
  const axis = { gridcolor: rule, linecolor: rule, zerolinecolor: rule, tickcolor: rule, automargin: true };
  const bar = { outlinewidth: 0, thickness: 12, tickfont: { color: ink } };
  const names = ["measured", "simulated", "accent", "soft"];
  return {
    layout: {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", colorway: names.map(colour),
      font: { color: ink, family: "system-ui, sans-serif", size: 12 },
      hoverlabel: { bgcolor: colour("panel"), bordercolor: rule, font: { color: ink } },
      margin: { l: 56, r: 12, t: 28, b: 44 }, xaxis: axis, yaxis: axis,
      coloraxis: { colorbar: bar }, legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("soft"), activecolor: ink },
    },
  };
}

// Width of a figure on paper [px]: A4 and Letter hold it between their margins. null on screen, where figures fill the page.
const PAPER_PX = 660;
let paper = null;

/** Draws or redraws a figure in an element, in the page's colours. */
function draw(element, data, layout, config = {}) {
  return Plotly.react(element, data, { ...layout, ...(paper && { width: paper }), template: template() }, { ...CONFIG, ...config });
}

/** The figure that stands as JSON behind an element; var(--name) in it is a colour of the page. */
function drawWritten(element) {
  const text = document.getElementById(`${element.id}-data`).textContent;
  const figure = JSON.parse(text.replace(/var\(--(\w+)\)/g, (_, name) => colour(name)));
  element.dataset.drawn = "yes";
  return draw(element, figure.data, figure.layout);
}

/** Draws elements when they come into view, and again when the ground changes. */
function drawInView(elements, drawing) {
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      seen.unobserve(entry.target);
      drawing(entry.target);
    }
  }, { rootMargin: "200px" });
  elements.forEach((element) => seen.observe(element));
  // In a closed fold nothing can be measured: what is there is drawn anew when it opens.
  const anew = () => elements.forEach((own) => own.dataset.drawn && (own.checkVisibility() ? drawing(own) : seen.observe(own)));
  GROUNDS.forEach((ground) => ground.addEventListener("change", anew));
}

/** Opens the folds around the place that the address names. */
function openTarget() {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let own = target; own; own = own.parentElement) if (own.tagName === "DETAILS") own.open = true;
  target.scrollIntoView();
}

/** Sorts a table by the column of a button in its head, largest first, then the other way round. */
function sortBy(button) {
  const head = button.closest("th"), table = button.closest("table"), column = head.cellIndex;
  const down = head.getAttribute("aria-sort") !== "descending";
  for (const other of head.parentElement.cells) if (other.hasAttribute("aria-sort")) other.setAttribute("aria-sort", "none");
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
  const order = (a, b) => {
    const [one, two] = [key(a), key(b)], numbers = [Number(one), Number(two)];
    if (one === "" || two === "") return (one === "") - (two === ""); // what is not known comes last
    const found = numbers.some(Number.isNaN) ? two.localeCompare(one) : numbers[1] - numbers[0];
    return down ? found : -found;
  };
  for (const body of table.tBodies) body.append(...[...body.rows].sort(order));
}

const written = document.querySelectorAll("[data-plot]");
drawInView(written, drawWritten);
document.querySelectorAll("table.sortable th button").forEach((own) => own.addEventListener("click", () => sortBy(own)));
addEventListener("hashchange", openTarget);
document.querySelectorAll('a[href^="#"]').forEach((own) => own.addEventListener("click", () => setTimeout(openTarget)));

let unfolded = [];
addEventListener("beforeprint", () => {
  paper = PAPER_PX;
  unfolded = [...document.querySelectorAll("details:not([open])")];
  unfolded.forEach((own) => { own.open = true; });
  written.forEach((own) => own.dataset.drawn || drawWritten(own));
  document.querySelectorAll(".js-plotly-plot").forEach((own) => Plotly.relayout(own, { width: paper }));
});
addEventListener("afterprint", () => {
  paper = null;
  unfolded.forEach((own) => { own.open = false; });
  document.querySelectorAll(".js-plotly-plot").forEach((own) => Plotly.relayout(own, { width: null, autosize: true }));
});
openTarget();
