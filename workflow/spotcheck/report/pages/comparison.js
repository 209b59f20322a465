// The picture of one quantity over the datasets, chosen by name.
const over = JSON.parse(document.getElementById("over-data").textContent);
const overPlot = document.getElementById("over-plot"), overChoice = document.getElementById("quantity");

/** Draws the chosen quantity with its error bars, and the line of its trend. */
function drawOver() {
  const own = over.quantities[Number(overChoice.value)], at = over.places;
  const data = [{
    type: "scatter", mode: "markers", x: at, y: own.y, text: own.text, customdata: over.labels, marker: { size: 9 },
    error_y: { array: own.e.map((error) => error ?? 0), thickness: 1.5, width: 4 }, showlegend: false,
    hovertemplate: "%{customdata}: %{text}<extra></extra>",
  }];
  if (own.line) {
    const ends = [Math.min(...at), Math.max(...at)];
    data.push({
      type: "scatter", mode: "lines", x: ends, y: ends.map((x) => own.line[0] + own.line[1] * x), showlegend: false,
      line: { color: colour("soft"), dash: "dash" }, hoverinfo: "skip",
    });
  }
  const ticks = over.named ? { tickvals: at, ticktext: over.labels } : {};
  const layout = {
    xaxis: { title: { text: over.along }, ...ticks }, yaxis: { title: { text: own.unit ? `${own.name}<br>[${own.unit}]` : own.name } },
    hovermode: "closest", margin: { l: 70, r: 12, t: 16, b: 44 },
  };
  const said = own.text.map((text, k) => `${over.labels[k]} ${text}`).join("; ");
  overPlot.setAttribute("aria-label", `${own.name}: ${said}. ${own.said}`);
  document.getElementById("over-text").textContent = own.said ? `${own.name}: ${own.said}.` : own.name;
  overPlot.dataset.drawn = "yes";
  return draw(overPlot, data, layout);
}

over.quantities.forEach((own, k) => {
  let group = [...overChoice.children].find((one) => one.label === own.group);
  if (!group) {
    group = document.createElement("optgroup");
    group.label = own.group;
    overChoice.append(group);
  }
  group.append(new Option(own.mark + own.name, k));
});
overChoice.value = "0";
overChoice.addEventListener("change", drawOver);
drawInView([overPlot], drawOver);
addEventListener("beforeprint", drawOver);
