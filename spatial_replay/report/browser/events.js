// What changed, in sentences; choosing one goes there.

function makeEvents(clock) {
  const place = body("events");
  const {events} = clock.run;
  if (!events.length) {
    place.append(element("p", {}, "No verdict changed, and no sign for longer than a moment."));
    return;
  }
  const rows = events.map((event) => {
    const row = element("button", {type: "button", class: "event", onclick: () => {
      clock.pause();
      goTo(clock, event);
    }}, mark(event.standing), element("time", {}, secondsText(event.time)),
    element("span", {class: "hidden"}, STANDINGS[event.standing].words),
    element("span", {class: "sentence"}, ...withCode(event.parts)));
    return row;
  });
  const list = element("ol", {class: "list"}, ...rows.map((row) => element("li", {}, row)));
  place.append(list);
  const starts = events.map((event) => event.time);
  let here = null;
  clock.on("time", () => {
    const now = starts[0] <= clock.time + 1e-9 ? indexAt(starts, clock.time) : -1;
    if (now === here) return;
    if (here !== null && here >= 0) rows[here].removeAttribute("aria-current");
    here = now;
    if (now < 0) return;
    rows[now].setAttribute("aria-current", "true");
    keepInSight(list, rows[now].parentElement);
  });
}

// Scrolls a list, and nothing around it, so that one of its rows shows.
function keepInSight(list, row) {
  const top = row.offsetTop;
  if (top < list.scrollTop) list.scrollTop = top;
  else if (top + row.offsetHeight > list.scrollTop + list.clientHeight) {
    list.scrollTop = top + row.offsetHeight - list.clientHeight;
  }
}
