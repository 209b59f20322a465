// What can be wrong with how a page looks; each function gives one line for every fault.
window.looks = (() => {
  // The drawing in which Plotly measures texts, out of sight.
  const TESTER = "js-plotly-tester";

  // Where an element is, so that a person finds it: its own tag, name and classes, and its nearest ancestor with a name.
  function place(element) {
    const own = element.tagName.toLowerCase() + (element.id ? "#" + element.id : "")
      + [...element.classList].map((name) => "." + name).join("");
    const around = element.parentElement && element.parentElement.closest("[id]");
    const text = (element.textContent || "").trim().replace(/\s+/g, " ").slice(0, 40);
    return (around ? "#" + around.id + " " : "") + own + (text ? ` "${text}"` : "");
  }

  const visible = (element) => element.checkVisibility({ opacityProperty: true, visibilityProperty: true });

  // A box of its own that scrolls holds what is wider than the window; one that cuts off does not, where it is the page.
  function boxed(element) {
    for (let box = element.parentElement; box && box !== document.body; box = box.parentElement) {
      if (getComputedStyle(box).overflowX !== "visible") return true;
    }
    return false;
  }

  function overflow() {
    const wide = document.documentElement.clientWidth;
    const faults = [...document.body.querySelectorAll("*")].filter((element) => {
      if (element.id === TESTER || (element.closest("svg") && element.tagName !== "svg")) return false;
      if (!visible(element) || boxed(element)) return false;
      const own = element.getBoundingClientRect();
      return own.width > 0 && own.height > 1 && (own.right > wide + 0.5 || own.left < -0.5);
    }).filter((element, _, all) => !all.includes(element.parentElement)).map((element) => {
      const own = element.getBoundingClientRect();
      return `${place(element)} spans ${own.left.toFixed()} to ${own.right.toFixed()} px of ${wide}`;
    });
    const whole = document.scrollingElement.scrollWidth;
    if (!faults.length && whole > wide) faults.push(`the page is ${whole} px wide in a window of ${wide}`);
    return faults;
  }

  // What a screen reader says of an element, from the element itself.
  function label(element) {
    const by = element.getAttribute("aria-labelledby");
    const named = by && by.split(" ").map((id) => document.getElementById(id)?.textContent || "").join(" ");
    return (named || element.getAttribute("aria-label") || element.getAttribute("alt") || "").trim();
  }

  // Inside a graph of Plotly are many pictures; the graph speaks for them.
  function unnamed() {
    const pictures = document.querySelectorAll("img, svg, canvas, .js-plotly-plot");
    return [...pictures].filter((element) => {
      if (element.parentElement.closest(".js-plotly-plot, svg, [aria-hidden=true], [role=img]")) return false;
      if (element.getAttribute("aria-hidden") === "true" || element.id === TESTER) return false;
      const spoken = element.tagName === "IMG" || ["img", "figure", "group"].includes(element.getAttribute("role"));
      return !label(element) || !spoken;
    }).map((element) => `${place(element)} has no alternative text`);
  }

  function headings() {
    const faults = [];
    let last = 0;
    for (const element of document.querySelectorAll("h1, h2, h3, h4, h5, h6")) {
      const level = Number(element.tagName[1]);
      if (level > last + 1) faults.push(`${place(element)} follows a heading of level ${last}`);
      if (level === 1 && last > 0) faults.push(`${place(element)} is a second title`);
      last = level;
    }
    return last ? faults : ["the page has no heading"];
  }

  // Red, green, blue and opacity of any colour that CSS can write, as the browser paints it.
  const brush = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const painted = new Map();
  function paint(color) {
    if (!painted.has(color)) {
      brush.clearRect(0, 0, 1, 1);
      brush.fillStyle = color;
      brush.fillRect(0, 0, 1, 1);
      painted.set(color, [...brush.getImageData(0, 0, 1, 1).data].map((value) => value / 255));
    }
    return painted.get(color);
  }
  const over = (top, part, under) => under.map((value, k) => top[k] * part + value * (1 - part));

  // Relative luminance of WCAG 2, which defines sRGB's curve by 0.04045.
  const linear = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
  const luminance = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);

  function background(element) {
    const chain = [];
    for (let box = element; box; box = box.parentElement) chain.push(box);
    // The canvas behind the page is white, or what the browser paints under a dark scheme.
    let seen = paint("Canvas").slice(0, 3);
    for (const box of chain.reverse()) {
      const style = getComputedStyle(box);
      const own = paint(style.backgroundColor);
      seen = over(own, own[3], seen);
    }
    return seen;
  }

  function texts() {
    const found = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      const element = walker.currentNode.parentElement;
      if (!walker.currentNode.data.trim() || element.closest("script, style, template, noscript")) continue;
      if (visible(element)) found.push([walker.currentNode.data.trim(), element]);
    }
    return found;
  }

  function faint(least) {
    const faults = new Set();
    for (const [, element] of texts()) {
      const style = getComputedStyle(element);
      const own = paint(element.closest("svg") ? style.fill : style.color);
      let part = own[3];
      for (let box = element; box; box = box.parentElement) part *= Number(getComputedStyle(box).opacity);
      const behind = background(element);
      const [low, high] = [luminance(over(own, part, behind)), luminance(behind)].sort((a, b) => a - b);
      const contrast = (high + 0.05) / (low + 0.05);
      if (contrast < least) faults.add(`${place(element)} has contrast ${contrast.toFixed(2)}`);
    }
    return [...faults];
  }

  // Words that a program leaves where a number or a name is missing; "None holds" is English.
  const LEFT = /(?<![\p{L}\p{N}_])(NaN|nan|None(?! (?:holds|of)\b)|undefined|null|[-−+]?inf|Infinity|\[object Object\])(?![\p{L}\p{N}_])/u;
  function leftovers() {
    const spoken = [...document.querySelectorAll("[alt], [aria-label], [title]")].flatMap((element) =>
      ["alt", "aria-label", "title"].map((name) => [element.getAttribute(name) || "", element]));
    return [...texts(), ...spoken].filter(([text]) => LEFT.test(text))
      .map(([text, element]) => `${place(element)} reads "${text.slice(0, 80)}"`);
  }

  const unfold = (open) => document.querySelectorAll("details").forEach((own) => { own.open = open; });

  const CONTROLS = "a[href], button, input, select, textarea, summary, [tabindex]";

  // A box of text alone that is wider than it shows: a keyboard scrolls it once it has the focus.
  const scrolls = (own) => own.tagName === "DIV" && own.scrollWidth > own.clientWidth && !own.querySelector(CONTROLS)
    && ["auto", "scroll"].includes(getComputedStyle(own).overflowX);

  // What Tab should reach, in the order of the document; of radio buttons of one name Tab reaches one.
  function controls() {
    const all = [...document.querySelectorAll(`${CONTROLS}, div`)];
    // A graph's buttons are shown when they have the focus.
    return all.filter((own) => (own.tabIndex >= 0 || scrolls(own)) && !own.disabled && (visible(own) || (own.closest(".modebar") && own.checkVisibility()))
      && !(own.type === "radio" && !own.checked && document.querySelector(`input[name="${own.name}"]:checked`)));
  }

  // Where the focus is: the number of the control, and whether it is seen there.
  function focused() {
    const own = document.activeElement;
    const style = getComputedStyle(own);
    const ring = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) > 0;
    return { at: controls().indexOf(own), seen: ring || style.boxShadow !== "none", place: place(own) };
  }

  // What stays folded, though all of it should be seen.
  function folded() {
    return [...document.querySelectorAll("details")].filter((own) =>
      [...own.children].some((child) => child.tagName !== "SUMMARY" && getComputedStyle(child).display !== "none"
        && !child.checkVisibility())).map((own) => `${place(own)} is folded`);
  }

  // What a box hides of its content; nobody scrolls on paper.
  function cut() {
    return [...document.body.querySelectorAll("*")].filter((own) => !own.closest("svg, .js-plotly-plot") && visible(own)
      && getComputedStyle(own).overflowX !== "visible" && own.scrollWidth > own.clientWidth + 1)
      .map((own) => `${place(own)} shows ${own.clientWidth} of ${own.scrollWidth} px`);
  }

  // What a graph of Plotly holds: pixels of its images by title, their colour scales, the axes that they stand on.
  const heatmaps = (id) => document.getElementById(id).data.filter((trace) => trace.type === "heatmap");
  const images = (id) => Object.fromEntries(heatmaps(id).map((own) => [own.name, [...own.z].map((row) =>
    [...row].map((value) => (Number.isFinite(value) ? value : null)))]));
  const scales = (id) => Object.fromEntries(heatmaps(id).map((own) => [own.name, own.coloraxis]));
  const axis = (id, name) => document.getElementById(id)._fullLayout[name.replace(/([xy])/, "$1axis")];
  const ranges = (id) => heatmaps(id).map((own) => [axis(id, own.xaxis || "x").range, axis(id, own.yaxis || "y").range]);
  const axisTypes = (id) => document.getElementById(id).data.map((own) => axis(id, own.yaxis || "y").type);
  const pointed = (id) => document.getElementById(id)._hoverdata[0].pointNumber;
  const index = () => JSON.parse(document.getElementById("frames-index").textContent);
  const chosen = () => index().axes.map((own) => Number(document.getElementById("viewer-controls").elements[`axis-${own.name}`].value));
  const frame = (number) => index().frames[number].at;

  // Words of a graph that reach beyond it, where nobody sees them.
  function beyond() {
    return [...document.querySelectorAll(".js-plotly-plot svg text")].filter((own) => {
      const [word, graph] = [own, own.closest(".js-plotly-plot")].map((one) => one.getBoundingClientRect());
      return visible(own) && word.width > 0 && (word.left < graph.left - 1 || word.right > graph.right + 1
        || word.top < graph.top - 1 || word.bottom > graph.bottom + 1);
    }).map((own) => `${place(own.closest(".js-plotly-plot"))}: "${own.textContent}" reaches beyond the graph`);
  }

  // Scrolls through the page, as a reader does, so that what waits to be seen is drawn; ends at the top.
  async function visit() {
    for (let y = 0; y < document.scrollingElement.scrollHeight; y += innerHeight) {
      scrollTo(0, y);
      // Not by requestAnimationFrame, which a busy machine may leave unanswered.
      await new Promise((next) => setTimeout(next, 50));
    }
    scrollTo(0, 0);
  }

  return { place, visible, overflow, unnamed, headings, faint, leftovers, unfold, visit, controls, focused, folded, cut, beyond,
    images, scales, ranges, axisTypes, pointed, chosen, frame };
})();
