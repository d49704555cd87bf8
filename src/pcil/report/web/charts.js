"use strict";
// Draws the charts of a report with uPlot: values under the pointer, zoom, and a choice of methods and tasks.
(() => {
  const charts = JSON.parse(document.getElementById("chart-data").textContent);
  const place = document.getElementById("charts");
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const shown = (value) => (value == null ? "" : Math.abs(value) >= 10 ? value.toFixed(1) : value.toFixed(2));
  const count = (value) => (value >= 1e6 ? value / 1e6 + "M" : value >= 1e3 ? value / 1e3 + "k" : String(value));
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const inked = (ink, part) => `color-mix(in srgb, color-mix(in srgb, ${ink} ${dark.matches ? 55 : 100}%, white) ${part}%, transparent)`;
  const hidden = { methods: new Set(), tasks: new Set() };

  function options(chart, width) {
    const axis = { stroke: () => colour("--soft"), grid: { stroke: () => colour("--rule"), width: 1 }, ticks: { show: false } };
    const series = [{ label: "frames", value: (u, value) => (value == null ? "" : value.toLocaleString("en")) }];
    const bands = [];
    for (const line of chart.lines) {
      const at = series.length;
      const own = { stroke: () => inked(line.colour, 100), dash: line.dashes.map((length) => length * 2), show: !hidden.methods.has(line.name) };
      const value = (u, middle, s, i) => {
        if (i == null || middle == null) return "";
        return shown(middle) + (line.low[i] == null ? "" : ` [${shown(line.low[i])}, ${shown(line.high[i])}]`);
      };
      const bound = { show: own.show, class: "bound", stroke: "transparent", width: 0, points: { show: false } };
      series.push({ ...own, label: line.name, value, width: 2, points: { show: false }, spanGaps: true });
      series.push({ ...bound, label: line.name + " low", spanGaps: true }, { ...bound, label: line.name + " high", spanGaps: true });
      bands.push({ series: [at + 2, at + 1], fill: () => inked(line.colour, 15) });
    }
    if (chart.expert != null) {
      const grey = { stroke: () => colour("--soft"), dash: [4, 4], width: 1, points: { show: false } };
      series.push({ ...grey, label: "demonstrations", value: (u, value) => shown(value) });
    }
    return {
      width, height: 280, series, bands,
      scales: { x: { time: false } },
      axes: [
        { ...axis, label: "frames", labelSize: 16, size: 28, labelFont: "12px system-ui", values: (u, ticks) => ticks.map(count) },
        { ...axis, label: chart.y, labelSize: 22, labelFont: "12px system-ui" },
      ],
      cursor: { drag: { x: true, y: true, uni: 20 }, focus: { prox: 24 } },
    };
  }

  function data(chart) {
    const rows = [chart.frames];
    for (const line of chart.lines) rows.push(line.center, line.low, line.high);
    if (chart.expert != null) rows.push(chart.frames.map(() => chart.expert));
    return rows;
  }

  function choices(title, names, colours, changed) {
    const field = document.createElement("fieldset");
    field.className = "choices";
    field.appendChild(document.createElement("legend")).textContent = title;
    for (const name of names) {
      const row = field.appendChild(document.createElement("label"));
      const box = row.appendChild(document.createElement("input"));
      box.type = "checkbox";
      box.checked = true;
      box.addEventListener("change", () => changed(name, box.checked));
      if (colours[name]) row.appendChild(document.createElement("i")).style.setProperty("--line", colours[name]);
      row.append(name);
    }
    place.before(field);
  }

  const drawn = charts.map((chart) => {
    const frame = place.appendChild(document.createElement("div"));
    frame.className = "chart";
    frame.appendChild(document.createElement("h3")).textContent = chart.title;
    return { chart, frame, plot: null };
  });
  window.charted = drawn;
  place.className = "charts";
  const colours = {};
  for (const { chart } of drawn) for (const line of chart.lines) colours[line.name] = line.colour;
  choices("methods", Object.keys(colours), colours, (name, on) => {
    hidden.methods[on ? "delete" : "add"](name);
    for (const { chart, plot } of drawn) {
      const number = chart.lines.findIndex((line) => line.name === name);
      if (number >= 0) for (const part of [1, 2, 3]) plot.setSeries(3 * number + part, { show: on });
    }
  });
  if (charts.length > 1) {
    choices("tasks", charts.map((chart) => chart.title), {}, (title, on) => {
      for (const { chart, frame } of drawn) if (chart.title === title) frame.hidden = !on;
    });
  }
  for (const each of drawn) each.plot = new uPlot(options(each.chart, each.frame.clientWidth), data(each.chart), each.frame);
  const sized = new ResizeObserver((entries) => {
    for (const { target, contentRect } of entries) {
      const { plot } = drawn.find(({ frame }) => frame === target);
      if (contentRect.width && plot.width !== Math.floor(contentRect.width)) {
        plot.setSize({ width: Math.floor(contentRect.width), height: 280 });
      }
    }
  });
  for (const { frame } of drawn) sized.observe(frame);
  dark.addEventListener("change", () => drawn.forEach(({ plot }) => plot.redraw()));
})();
