// The plot of one quantity over the datasets; a menu selects the quantity.
const comparison = JSON.parse(document.getElementById("quantity-data").textContent);
const quantityPlot = document.getElementById("quantity-plot"), quantityMenu = document.getElementById("quantity");

/** Draws the selected quantity with its error bars, and the line of its trend. */
function drawQuantity() {
  const quantity = comparison.quantities[Number(quantityMenu.value)], { labels, places } = comparison;
  const data = [{
    type: "scatter", mode: "markers", x: places, y: quantity.values, text: quantity.texts, customdata: labels, marker: { size: 9 },
    error_y: { array: quantity.errors.map((error) => error ?? 0), thickness: 1.5, width: 4 }, showlegend: false,
    hovertemplate: "%{customdata}: %{text}<extra></extra>",
  }];
  if (quantity.line) {
    const ends = [Math.min(...places), Math.max(...places)], [level, slope] = quantity.line;
    data.push({
      type: "scatter", mode: "lines", x: ends, y: ends.map((x) => level + slope * x), showlegend: false,
      line: { color: colour("soft"), dash: "dash" }, hoverinfo: "skip",
    });
  }
  const ticks = comparison.has_named_ticks ? { tickvals: places, ticktext: labels } : {};
  const title = quantity.unit ? `${quantity.name}<br>[${quantity.unit}]` : quantity.name;
  const layout = {
    xaxis: { title: { text: comparison.along }, ...ticks }, yaxis: { title: { text: title } },
    hovermode: "closest", margin: { l: 70, r: 12, t: 16, b: 44 },
  };
  const values = quantity.texts.map((text, k) => `${labels[k]} ${text}`).join("; ");
  quantityPlot.setAttribute("aria-label", `${quantity.name}: ${values}. ${quantity.trend}`);
  document.getElementById("quantity-caption").textContent = quantity.trend ? `${quantity.name}: ${quantity.trend}.` : quantity.name;
  quantityPlot.dataset.drawn = "yes";
  return draw(quantityPlot, data, layout);
}

comparison.quantities.forEach((quantity, k) => {
  let group = [...quantityMenu.children].find((element) => element.label === quantity.group);
  if (!group) {
    group = document.createElement("optgroup");
    group.label = quantity.group;
    quantityMenu.append(group);
  }
  group.append(new Option(quantity.prefix + quantity.name, k));
});
quantityMenu.value = "0";
quantityMenu.addEventListener("change", drawQuantity);
drawInView([quantityPlot], drawQuantity);
