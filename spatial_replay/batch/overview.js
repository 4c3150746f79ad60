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
