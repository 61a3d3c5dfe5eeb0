// Measured and simulated readings over time: drag to zoom, double-click to reset, click a name to hide a line.
document.querySelectorAll("script[data-overlay]").forEach(source => {
  const data = JSON.parse(source.textContent), plot = source.closest(".plot"), names = Object.keys(data.runs);
  const root = plot.parentElement.insertBefore(Object.assign(document.createElement("div"), {className: "overlay"}), plot);
  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const colours = () => [css("--ink"), css("--blue"), css("--over")];
  let plots = [], zoomed = false;
  const follow = (u, key) => {
    if (key !== "x" || zoomed) return;
    zoomed = true;
    plots.forEach(other => { if (other !== u) other.setScale("x", {min: u.scales.x.min, max: u.scales.x.max}); });
    zoomed = false;
  };
  const draw = name => {
    plots.forEach(u => u.destroy());
    plots = [];
    const {time, channels} = data.runs[name], [ink, ...lines] = colours(), width = Math.max(260, root.clientWidth - 4);
    const axis = options => ({stroke: ink, grid: {stroke: css("--line"), width: 1}, ticks: {stroke: css("--line"), width: 1}, font: "11px sans-serif", labelFont: "bold 11px sans-serif", labelSize: 18, ...options});
    const add = (label, height, values, series, last) => plots.push(new uPlot({
      width, height, series: [{label: "time", value: (u, v) => v == null ? "" : v.toPrecision(5) + " s"}, ...series],
      scales: {x: {time: false}}, cursor: {sync: {key: source.dataset.overlay}}, hooks: {setScale: [follow]},
      axes: [axis(last ? {label: "time [s]", size: 28} : {size: 28}), axis({label, size: 58})],
    }, [time, ...values], root));
    channels.forEach((values, k) => {
      const {label, unit} = data.channels[k], measured = values[0];
      const value = (u, v) => v == null ? "" : v.toPrecision(4) + " " + unit;
      const each = data.labels.map((name, n) => n ? {label: name, stroke: lines[n - 1], width: 1.5, value}
        : {label: name, stroke: ink, width: 0, points: {show: true, size: 4, fill: ink}, value});
      add(`${label} [${unit}]`, 170, values, each);
      const off = values.slice(1).map(simulated => simulated.map((v, i) => v == null || measured[i] == null ? null : v - measured[i]));
      add(`residual [${unit}]`, 130, off, off.map((_, n) => ({label: data.labels[n + 1] + " − measured", stroke: lines[n], width: 1, value})), k === channels.length - 1);
    });
  };
  const hint = document.createElement("p");
  hint.className = "key";
  hint.textContent = "Drag to zoom, double-click to reset, click a name to hide its line. ";
  if (names.length > 1) {
    const choice = hint.appendChild(document.createElement("select"));
    choice.setAttribute("aria-label", "run");
    names.forEach(name => choice.add(new Option("run " + name, name)));
    choice.addEventListener("change", () => draw(choice.value));
  }
  root.append(hint);
  root.ranges = () => plots.map(u => [u.scales.x.min, u.scales.x.max]);
  plot.classList.add("printed");
  draw(names[0]);
  let width = root.clientWidth;
  new ResizeObserver(() => {
    if (root.clientWidth === width) return;
    width = root.clientWidth;
    plots.forEach(u => u.setSize({width: Math.max(260, width - 4), height: u.height}));
  }).observe(root);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => draw(names.length > 1 ? root.querySelector("select").value : names[0]));
});
