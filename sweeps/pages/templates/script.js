// Tables are sorted by a click on a heading, and stacked on a phone. Nothing is fetched.
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
