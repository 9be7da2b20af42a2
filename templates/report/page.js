"use strict";
(() => {
  const root = document.documentElement;
  const wantsDark = window.matchMedia("(prefers-color-scheme: dark)");

  /* ---- on paper nothing scrolls, so a formula that is too wide is set smaller ---- */
  function shrink(paper) {
    document.querySelectorAll(".formula math").forEach((m) => { m.style.fontSize = ""; });
    if (!paper) { return; }
    document.querySelectorAll(".formula math").forEach((m) => {
      const room = m.parentElement.clientWidth - 20, need = m.getBoundingClientRect().width;
      if (need > room) { m.style.fontSize = `${Math.max(0.4, room / need).toFixed(3)}em`; }
    });
  }
  const onPaper = window.matchMedia("print");
  onPaper.addEventListener("change", () => shrink(onPaper.matches));
  window.addEventListener("beforeprint", () => shrink(true));
  window.addEventListener("afterprint", () => shrink(false));

  const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const charts = [];

  /* ---- light and dark ---- */
  const button = document.getElementById("theme");
  const isDark = () => (root.dataset.theme || (wantsDark.matches ? "dark" : "light")) === "dark";
  const name = () => { button.textContent = isDark() ? "Light" : "Dark"; button.setAttribute("aria-label", `Switch to ${isDark() ? "light" : "dark"} colours`); };
  button.hidden = false;
  button.addEventListener("click", () => { root.dataset.theme = isDark() ? "light" : "dark"; name(); redraw(); });
  wantsDark.addEventListener("change", () => { name(); redraw(); });
  name();

  const holder = document.getElementById("plot-data");
  if (!holder) { return; }
  const data = JSON.parse(holder.textContent);
  const column = (y) => typeof y === "string" ? data.columns[y] : y;
  [...data.panels, ...data.portraits].forEach((p) => p.series.forEach((s) => { s.x = column(s.x); s.y = column(s.y); }));

  /* ---- how each kind of curve is drawn ---- */
  const DASH = { target: [7, 4], bound: [2, 4], dash: [9, 5] };
  const pen = (s) => (s.style === "target" || s.style === "bound") && s.shared ? colour("--level") : colour(`--c${s.colour % 4}`);
  const faded = (css) => { const n = parseInt(css.slice(1), 16); return `rgba(${n >> 16},${(n >> 8) & 255},${n & 255},0.32)`; };
  const stroke = (s) => () => s.style === "band" ? faded(pen(s)) : pen(s);
  const width = (s) => s.style === "band" ? 6 : s.style === "bound" ? 2 : 1.6;
  const short = (v) => v === null || v === undefined ? "–" : Number(v.toPrecision(5)).toString().replace("-", "−");
  const pixels = () => Math.max(2, window.devicePixelRatio || 1);

  const axis = (label, more) => Object.assign({
    label, labelSize: 18, labelGap: 0, labelFont: "12px system-ui, sans-serif", font: "11px system-ui, sans-serif",
    stroke: () => colour("--muted"), grid: { stroke: () => colour("--grid"), width: 1 }, ticks: { stroke: () => colour("--grid"), width: 1 },
  }, more);
  const ticks = (u, values) => values.map((v) => v === null ? "" : short(v));

  /* Powers of ten, at most about six of them. */
  const powers = (u, axisIndex, min, max) => {
    const lo = Math.ceil(Math.log10(min) - 1e-9), hi = Math.floor(Math.log10(max) + 1e-9), stride = Math.max(1, Math.ceil((hi - lo) / 5));
    return Array.from({ length: Math.max(0, Math.floor((hi - lo) / stride) + 1) }, (_, k) => Number(`1e${lo + k * stride}`));
  };

  function swatch(s) {
    const opacity = s.style === "band" ? 0.4 : 1;
    return `<svg viewBox="0 0 28 10" aria-hidden="true"><line x1="1" x2="27" y1="5" y2="5" stroke="var(--c${s.colour % 4})" stroke-opacity="${opacity}" stroke-width="${width(s) * 1.2}" stroke-dasharray="${(DASH[s.style] || []).join(" ")}"/></svg>`;
  }
  function legend(figure, panel, chart) {
    const box = figure.querySelector(".legend");
    panel.series.forEach((s, k) => {
      const b = document.createElement("button");
      b.type = "button";
      b.innerHTML = swatch(s);
      b.append(s.label);
      b.setAttribute("aria-pressed", "true");
      b.addEventListener("click", () => {
        const shown = b.getAttribute("aria-pressed") !== "true";
        b.setAttribute("aria-pressed", String(shown));
        chart.setSeries(k + 1, { show: shown });
      });
      box.append(b);
    });
  }
  const size = (element) => ({ width: Math.max(200, element.clientWidth), height: Math.max(120, element.clientHeight) });

  /* ---- panels over time, with one cursor and one window ---- */
  let busy = false;
  const follow = (u) => {
    if (busy) { return; }
    busy = true;
    const { min, max } = u.scales.x;
    charts.forEach((c) => { if (c !== u && c.mode === 1) { c.setScale("x", { min, max }); } });
    busy = false;
  };
  function read(u, figure, panel) {
    const k = u.cursor.idx;
    const line = figure.querySelector(".readout");
    if (k === null || k === undefined) { line.textContent = ""; return; }
    const values = panel.series.filter((s) => Array.isArray(s.y)).map((s) => `${s.label} ${short(s.y[k])}`);
    line.textContent = `t = ${short(data.times[k])} s: ${values.join("; ")}`;
  }
  function overTime(figure, panel) {
    const element = figure.querySelector(".canvas");
    const count = data.times.length;
    const fixed = panel.series.filter((s) => !Array.isArray(s.y));
    fixed.forEach((s) => { s.shared = panel.series.some((o) => o.colour !== s.colour) === false; });
    const largest = Math.max(0, ...panel.series.flatMap((s) => Array.isArray(s.y) ? [s.y[0] || 0] : []));
    const floor = panel.kind === "energy" ? Math.max(1e-9 * largest, Number.MIN_VALUE) : -Infinity; /* below it is rounding */
    const columns = panel.series.map((s) => Array.isArray(s.y) ? s.y.map((v) => v !== null && v < floor ? null : v) : new Array(count).fill(s.y));
    const options = {
      ...size(element), pxRatio: pixels(),
      scales: { x: { time: false }, ...(panel.kind === "energy" ? { y: { distr: 3 } } : {}) },
      series: [{}, ...panel.series.map((s) => ({
        label: s.label, stroke: stroke(s), width: width(s), dash: DASH[s.style], points: { show: false }, cap: "round", pxAlign: 0,
        paths: s.style === "step" ? uPlot.paths.stepped({ align: 1 }) : undefined, spanGaps: false,
      }))],
      axes: [axis("time [s]", { values: ticks, size: 30 }), axis(undefined, { values: ticks, size: 62, ...(panel.kind === "energy" ? { splits: powers, values: (u, vs) => vs.map((v) => v === null ? "" : v.toExponential(0).replace("-", "−")) } : {}) })],
      cursor: { sync: { key: "loop" }, drag: { x: true, y: false, setScale: true }, points: { size: 6 } },
      legend: { show: false },
      hooks: { setScale: [(u, key) => { if (key === "x") { follow(u); } }], setCursor: [(u) => read(u, figure, panel)] },
    };
    const chart = new uPlot(options, [data.times, ...columns], element);
    element.addEventListener("keydown", (event) => keys(event, chart));
    return chart;
  }
  function keys(event, chart) {
    const { min, max } = chart.scales.x;
    const first = data.times[0], last = data.times[data.times.length - 1];
    const at = chart.cursor.idx ?? Math.floor(data.times.length / 2);
    const show = (k) => {
      const index = Math.min(data.times.length - 1, Math.max(0, k));
      chart.setCursor({ left: chart.valToPos(data.times[index], "x"), top: chart.over.clientHeight / 2 });
    };
    const magnify = (factor) => {
      const middle = data.times[at] >= min && data.times[at] <= max ? data.times[at] : (min + max) / 2;
      const half = (max - min) * factor / 2;
      chart.setScale("x", { min: Math.max(first, middle - half), max: Math.min(last, middle + half) });
    };
    const stride = event.shiftKey ? 25 : 1;
    const actions = { ArrowLeft: () => show(at - stride), ArrowRight: () => show(at + stride), "+": () => magnify(0.5), "=": () => magnify(0.5), "-": () => magnify(2), 0: () => chart.setScale("x", { min: first, max: last }) };
    if (actions[event.key]) { event.preventDefault(); actions[event.key](); }
  }

  /* ---- phase portraits ---- */
  function path(u, index) {
    const s = u.series[index].meta, [xs, ys] = u.data[index], c = u.ctx;
    c.save();
    c.beginPath();
    c.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
    c.clip();
    c.beginPath();
    xs.forEach((x, k) => {
      const px = u.valToPos(x, "x", true), py = u.valToPos(ys[k], "y", true);
      if (k === 0) { c.moveTo(px, py); } else { c.lineTo(px, py); }
    });
    c.strokeStyle = stroke(s)();
    c.lineWidth = width(s) * pixels();
    c.setLineDash((DASH[s.style] || []).map((v) => v * pixels()));
    c.lineJoin = "round";
    c.stroke();
    c.restore();
    return null;
  }
  function region(u, panel) {
    const c = u.ctx;
    c.save();
    c.beginPath();
    c.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
    c.clip();
    (panel.region || []).forEach(([xs, ys]) => {
      c.beginPath();
      xs.forEach((x, k) => c[k ? "lineTo" : "moveTo"](u.valToPos(x, "x", true), u.valToPos(ys[k], "y", true)));
      c.fillStyle = faded(colour("--c2")).replace("0.32", "0.12");
      c.strokeStyle = colour("--c2");
      c.lineWidth = pixels();
      c.fill();
      c.stroke();
    });
    c.restore();
  }
  function marks(u, panel) {
    const c = u.ctx, r = 5 * pixels(), at = (x, y) => [u.valToPos(x, "x", true), u.valToPos(y, "y", true)];
    const [sx, sy] = at(panel.series[0].x[0], panel.series[0].y[0]), [tx, ty] = at(...panel.target);
    c.save();
    c.strokeStyle = colour("--ink");
    c.lineWidth = 1.6 * pixels();
    c.beginPath(); c.arc(sx, sy, r, 0, 7); c.stroke();
    c.beginPath(); c.moveTo(tx - r, ty - r); c.lineTo(tx + r, ty + r); c.moveTo(tx - r, ty + r); c.lineTo(tx + r, ty - r); c.stroke();
    c.restore();
  }
  function portrait(figure, panel) {
    const element = figure.querySelector(".canvas");
    const whole = (u) => { u.setScale("x", { min: panel.x_range[0], max: panel.x_range[1] }); u.setScale("y", { min: panel.y_range[0], max: panel.y_range[1] }); };
    const facets = [{ scale: "x", auto: false }, { scale: "y", auto: false }];
    const options = {
      ...size(element), pxRatio: pixels(), mode: 2,
      scales: { x: { time: false, auto: false, min: panel.x_range[0], max: panel.x_range[1] }, y: { auto: false, min: panel.y_range[0], max: panel.y_range[1] } },
      series: [null, ...panel.series.map((s) => ({ label: s.label, facets, meta: s, stroke: stroke(s), paths: path }))],
      axes: [axis(panel.x_title, { values: ticks, size: 30 }), axis(panel.y_title, { values: ticks, size: 56, labelSize: 22 })],
      cursor: { drag: { x: true, y: true, setScale: true }, points: { show: false }, bind: { dblclick: (u) => () => { whole(u); return null; } } },
      legend: { show: false },
      hooks: {
        drawClear: [(u) => region(u, panel)],
        draw: [(u) => marks(u, panel)],
        setCursor: [(u) => {
          const { left, top } = u.cursor, line = figure.querySelector(".readout");
          line.textContent = left < 0 ? "" : `${panel.x_title}: ${short(u.posToVal(left, "x"))}; ${panel.y_title}: ${short(u.posToVal(top, "y"))}`;
        }],
      },
    };
    const chart = new uPlot(options, [null, ...panel.series.map((s) => [s.x, s.y])], element);
    element.addEventListener("keydown", (event) => {
      const factor = { "+": 0.5, "=": 0.5, "-": 2 }[event.key];
      if (event.key === "0") { whole(chart); }
      if (factor) {
        ["x", "y"].forEach((key) => {
          const { min, max } = chart.scales[key], middle = (min + max) / 2, half = (max - min) * factor / 2;
          chart.setScale(key, { min: middle - half, max: middle + half });
        });
      }
    });
    return chart;
  }

  /* ---- draw, and draw again when the room or the paper changes ---- */
  function draw(panel, make) {
    const figure = document.getElementById(panel.id);
    const chart = make(figure, panel);
    charts.push(chart);
    legend(figure, panel, chart);
  }
  data.panels.forEach((panel) => draw(panel, overTime));
  data.portraits.forEach((panel) => draw(panel, portrait));
  const fit = () => charts.forEach((c) => c.setSize(size(c.root.parentElement)));
  function redraw() { charts.forEach((c) => c.redraw(false, true)); }
  const print = () => { fit(); redraw(); };
  new ResizeObserver(fit).observe(document.querySelector("main"));
  window.matchMedia("print").addEventListener("change", print);
  window.addEventListener("beforeprint", print);
  window.addEventListener("afterprint", print);
  window.charts = charts;
})();
