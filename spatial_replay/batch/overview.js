// Sorts the matrix by the column whose heading is pressed; again for the other way round.
const table = document.getElementById("matrix");
const body = table.tBodies[0];
const key = (row, place) => {
  const value = row.cells[place].dataset.value;
  return value === undefined ? row.cells[place].textContent : Number(value);
};
const compare = (one, other) =>
  typeof one === "number" && typeof other === "number"
    ? one - other
    : String(one).localeCompare(String(other), "en", { numeric: true });
for (const heading of table.tHead.rows[0].cells) {
  heading.firstElementChild.addEventListener("click", () => {
    const sign = heading.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", sign === 1 ? "ascending" : "descending");
    const rows = Array.from(body.rows, (row) => [key(row, heading.cellIndex), row]);
    rows.sort(([one], [other]) => sign * compare(one, other));
    body.append(...rows.map(([, row]) => row));
  });
}

// Lists the rows of a name, or only those that fail, and goes through those.
const filter = document.getElementById("filter");
const words = filter.querySelector("input[type=search]"), onlyFailing = document.getElementById("only-failing");
const isFailing = (row) => row.querySelector(".fails") !== null;
const list = () => {
  for (const row of body.rows) {
    const isNamed = row.cells[0].textContent.toLowerCase().includes(words.value.toLowerCase());
    row.hidden = !isNamed || (onlyFailing.checked && !isFailing(row));
  }
  const listed = Array.from(body.rows).filter((row) => !row.hidden).length;
  document.getElementById("left").textContent = listed < body.rows.length ? `${listed} of ${body.rows.length} listed` : "";
};
words.addEventListener("input", list);
onlyFailing.addEventListener("change", list);
const step = (by) => {
  const rows = Array.from(body.rows).filter((row) => !row.hidden && isFailing(row));
  if (!rows.length) return;
  const before = rows.findIndex((row) => row.classList.contains("here"));
  const next = rows[before < 0 ? (by > 0 ? 0 : rows.length - 1) : (before + by + rows.length) % rows.length];
  for (const row of body.rows) row.classList.toggle("here", row === next);
  next.scrollIntoView({block: "nearest"});
  next.querySelector("a")?.focus({preventScroll: true});
};
for (const button of filter.querySelectorAll(".step")) {
  button.addEventListener("click", () => step(Number(button.dataset.step)));
}
