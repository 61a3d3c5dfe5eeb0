// Tables are sorted by a click on a heading, and stacked on a phone; figures say what is under the pointer. Nothing is fetched.
document.querySelectorAll("table").forEach(table => {
  const heads = [...table.rows].filter(row => row.cells.length && [...row.cells].every(cell => cell.tagName === "TH"));
  const body = [...table.rows].filter(row => !heads.includes(row));
  if (body.some(row => row.className === "sub" || [...row.cells].some(cell => cell.rowSpan > 1))) return;
  const taken = heads.map(() => []), above = [];
  heads.forEach((row, r) => [...row.cells].forEach(head => {
    let column = 0;
    while (taken[r][column]) column++;
    for (let i = 0; i < head.rowSpan && r + i < heads.length; i++) for (let j = 0; j < head.colSpan; j++) taken[r + i][column + j] = true;
    if (head.colSpan > 1) for (let j = 0; j < head.colSpan; j++) above[column + j] = head.textContent + ", ";
    if (head.colSpan > 1 || r + head.rowSpan < heads.length || !head.textContent.trim()) return;
    body.forEach(row => { if (row.cells[column]) row.cells[column].dataset.head = (above[column] || "") + head.textContent; });
    if (body.length < 3) return;
    head.tabIndex = 0;
    head.title = "sort by this";
    const sort = () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      table.querySelectorAll("th[aria-sort]").forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const text = row => (row.cells[column] || row.cells[0]).textContent.trim();
      const number = row => parseFloat(text(row).replace("−", "-").replace(/^[^\d+.-]+/, ""));
      body.sort((a, b) => {
        const [x, y] = [number(a), number(b)], numbers = !isNaN(x) && !isNaN(y);
        return (up ? 1 : -1) * (numbers ? x - y : isNaN(x) !== isNaN(y) ? isNaN(x) - isNaN(y) : text(a).localeCompare(text(b)));
      }).forEach(row => row.parentElement.appendChild(row));
    };
    head.addEventListener("click", sort);
    head.addEventListener("keydown", e => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); sort(); } });
  }));
});
const stack = () => document.querySelectorAll(".scroll > table").forEach(table => {  // rows as lists where a phone would scroll
  table.classList.remove("stacked");
  table.classList.toggle("stacked", innerWidth < 600 && table.rows.length < 60 && table.scrollWidth > table.parentElement.clientWidth);
});
stack();
addEventListener("resize", stack);
addEventListener("toggle", stack, true);
const reading = document.body.appendChild(Object.assign(document.createElement("div"), {id: "reading", hidden: true}));
document.querySelectorAll("svg[data-axes]").forEach(svg => {
  const all = JSON.parse(svg.dataset.axes);
  let places;
  const found = () => {  // markers and corners of lines and bars, in the drawing's own units
    if (places) return places;
    places = [...svg.querySelectorAll("g use")].map(u => [u.x.baseVal.value, u.y.baseVal.value]);
    svg.querySelectorAll("g > path").forEach(path => {
      const at = [...(path.getAttribute("d") || "").matchAll(/[ML] (\S+) (\S+)/g)].map(m => [+m[1], +m[2]]);
      if (at.length > 2 && at.length < 2000 && !path.closest("g[id^=text], defs")) places.push(...at);
    });
    return places;
  };
  const value = (axis, share) => {
    const [low, high] = axis.ends, x = axis.log ? low * (high / low) ** share : low + (high - low) * share;
    const nearest = (a, b) => Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a;
    return (axis.label ? axis.label + ": " : "") + (axis.names ? axis.names.reduce(nearest)[1] : Number(x.toPrecision(4)));
  };
  svg.addEventListener("pointermove", event => {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const axes = all.find(({box: [x, y, w, h]}) => point.x >= x && point.x <= x + w && point.y >= y && point.y <= y + h);
    reading.hidden = !axes;
    if (!axes) return;
    const [x, y, w, h] = axes.box, within = ([a, b]) => a > x + .1 && a < x + w - .1 && b > y + .1 && b < y + h - .1;
    const far = ([a, b]) => Math.hypot(a - point.x, b - point.y);
    const near = found().filter(within).reduce((a, b) => far(b) < far(a) ? b : a, [Infinity, Infinity]);
    const [a, b] = far(near) < 9 ? near : [point.x, point.y];
    reading.textContent = [value(axes.x, (a - x) / w), value(axes.y, 1 - (b - y) / h)].join("; ");
    reading.style.left = Math.min(event.clientX + 14, innerWidth - reading.offsetWidth - 8) + "px";
    reading.style.top = Math.max(event.clientY - 34, 4) + "px";
  });
  svg.addEventListener("pointerleave", () => { reading.hidden = true; });
});
