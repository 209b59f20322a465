// Shared by all pages with plots: Plotly in the colours of the page, figures that are drawn when they come into view, folds
// that open if a link leads into them, and tables that sort.
"use strict";

// Media that change the colours of the page.
const COLOUR_SCHEMES = [matchMedia("(prefers-color-scheme: dark)"), matchMedia("print")];
const CONFIG = { responsive: true, displaylogo: false, displayModeBar: innerWidth < 500 ? false : "hover", modeBarButtonsToRemove: ["select2d", "lasso2d", "toImage"] };

/** Returns a colour of the page by its name in page.css. */
function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Returns Plotly's template in the colours of the page. */
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

// Width of a figure on paper [px], which fits between the margins of A4 and Letter. `paper` is null on screen, where
// figures fill the page.
const PAPER_PX = 660;
let paper = null;

/** Draws or redraws a figure in an element, in the colours of the page. */
function draw(element, data, layout, config = {}) {
  return Plotly.react(element, data, { ...layout, ...(paper && { width: paper }), template: template() }, { ...CONFIG, ...config });
}

/** Draws the figure that is embedded as JSON for an element; var(--name) in it is a colour of the page. */
function drawEmbedded(element) {
  const text = document.getElementById(`${element.id}-data`).textContent;
  const figure = JSON.parse(text.replace(/var\(--(\w+)\)/g, (_, name) => colour(name)));
  element.dataset.drawn = "yes";
  return draw(element, figure.data, figure.layout);
}

/** Calls `drawElement` for elements when they come into view, and again when the colours change. */
function drawInView(elements, drawElement) {
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      observer.unobserve(entry.target);
      drawElement(entry.target);
    }
  }, { rootMargin: "200px" });
  elements.forEach((element) => observer.observe(element));
  const redraw = () => elements.forEach((element) => {
    if (!element.dataset.drawn) return;
    // Elements in a closed fold have no size: they are redrawn when it opens.
    if (element.checkVisibility()) drawElement(element); else observer.observe(element);
  });
  COLOUR_SCHEMES.forEach((scheme) => scheme.addEventListener("change", redraw));
}

/** Opens the folds around the target of the address. */
function openTarget() {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let element = target; element; element = element.parentElement) if (element.tagName === "DETAILS") element.open = true;
  target.scrollIntoView();
}

/** Sorts a table by the column of a button in its head: first in descending, then in ascending order. */
function sortBy(button) {
  const head = button.closest("th"), table = button.closest("table"), column = head.cellIndex;
  const isDescending = head.getAttribute("aria-sort") !== "descending";
  for (const other of head.parentElement.cells) if (other.hasAttribute("aria-sort")) other.setAttribute("aria-sort", "none");
  head.setAttribute("aria-sort", isDescending ? "descending" : "ascending");
  const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
  const order = (a, b) => {
    const [first, second] = [key(a), key(b)], numbers = [Number(first), Number(second)];
    if (first === "" || second === "") return (first === "") - (second === ""); // unknown values come last
    const difference = numbers.some(Number.isNaN) ? second.localeCompare(first) : numbers[1] - numbers[0];
    return isDescending ? difference : -difference;
  };
  for (const body of table.tBodies) body.append(...[...body.rows].sort(order));
}

const embedded = document.querySelectorAll("[data-plot]");
drawInView(embedded, drawEmbedded);
document.querySelectorAll("table.sortable th button").forEach((button) => button.addEventListener("click", () => sortBy(button)));
addEventListener("hashchange", openTarget);
document.querySelectorAll('a[href^="#"]').forEach((link) => link.addEventListener("click", () => setTimeout(openTarget)));

let unfolded = [];
addEventListener("beforeprint", () => {
  paper = PAPER_PX;
  unfolded = [...document.querySelectorAll("details:not([open])")];
  unfolded.forEach((fold) => { fold.open = true; });
  embedded.forEach((element) => element.dataset.drawn || drawEmbedded(element));
  document.querySelectorAll(".js-plotly-plot").forEach((plot) => Plotly.relayout(plot, { width: paper }));
});
addEventListener("afterprint", () => {
  paper = null;
  unfolded.forEach((fold) => { fold.open = false; });
  document.querySelectorAll(".js-plotly-plot").forEach((plot) => Plotly.relayout(plot, { width: null, autosize: true }));
});
openTarget();
