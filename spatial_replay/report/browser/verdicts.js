// Verdicts: the status of a node at a sample, links from explanations to their times, and the list of events.

const STATUSES = {
  satisfied: {sign: "✓", words: "satisfied", colour: "positive"},
  holding: {sign: "+", words: "holds so far", colour: "positive"},
  violated: {sign: "✕", words: "violated", colour: "negative"},
  failing: {sign: "−", words: "fails now", colour: "negative"},
  pending: {sign: "−", words: "pending", colour: "pending"},
  unknown: {sign: "?", words: "unknown", colour: "neutral"},
  vacuous: {sign: "∅", words: "decided nothing", colour: "neutral"},
  absent: {sign: "·", words: "not evaluated here", colour: "neutral"},
};

// A node above all temporal operators is evaluated at the first sample: its status is the sign of its value on the
// samples so far and, at the last sample, its verdict. Other nodes have the status of the sample.
function statusOf(run, result, node, place) {
  const last = result.samples - 1;
  if (place === null || (place > last && !node.initial)) return "absent";
  const [value, now, lower, upper] = node.series;
  if (!node.initial) return signOf(now[place]);
  if (place >= last) return node.verdict;
  if (run.settles && lower[place] >= 0) return "satisfied";
  if (run.settles && upper[place] < 0) return "violated";
  // later samples may still fulfil the node, so it is not violated
  return run.settles && value[place] < 0 ? "pending" : signOf(value[place]);
}

function signOf(number) {
  if (number >= 0) return "holding";
  return number < 0 ? "failing" : "unknown";
}

// The periods of one status of a node: [from, to, status], in seconds.
function stretchesOf(run, result, node) {
  const stretches = [];
  const {times, samples} = result;
  let from = 0, status = samples ? statusOf(run, result, node, 0) : "absent";
  for (let place = 1; place < samples; place++) {
    const after = statusOf(run, result, node, place);
    if (after === status) continue;
    stretches.push([times[from], times[place], status]);
    from = place;
    status = after;
  }
  if (samples) stretches.push([times[from], run.times[run.times.length - 1], status]);
  return stretches;
}

function mark(status) {
  return element("span", {class: `mark is-${status}`, "aria-hidden": "true"}, STATUSES[status].sign);
}

function setMark(made, status) {
  made.className = `mark is-${status}`;
  made.textContent = STATUSES[status].sign;
}

// Makes a link of each time in an explanation.
function linkVerdicts(clock) {
  for (const time of document.querySelectorAll(".verdict [data-time-ns]")) {
    const result = Number(time.closest(".verdict").dataset.result);
    const link = element("button", {type: "button", class: "link", onclick: () => {
      clock.pause();
      clock.choose(result);
      clock.seek(Number(time.dataset.timeNs) / 1e9);
    }}, time.textContent);
    time.replaceWith(link);
  }
}

// Least visible height of the chosen verdict in the list, pixels.
const ROOM = 60;

// The list of results: its filter, and the choice of the result that the panels show.
function makeVerdicts(clock) {
  const verdicts = [...document.querySelectorAll(".verdict")];
  for (const verdict of verdicts) {
    if (verdict.dataset.result === undefined) continue;
    // a click on another result's heading chooses and unfolds that result; the chosen result's heading folds it
    verdict.querySelector("summary")?.addEventListener("click", (event) => {
      const number = Number(verdict.dataset.result);
      if (number === clock.result) return;
      event.preventDefault();
      clock.pause();
      clock.choose(number);
      clock.seek(clock.opening);
    });
  }
  const list = body("verdicts");
  clock.on("result", () => {
    for (const verdict of verdicts) {
      const isChosen = verdict.dataset.result === String(clock.result);
      verdict.classList.toggle("chosen", isChosen && verdicts.length > 1);
      if (!isChosen || verdicts.length < 2) continue;
      verdict.open = true;
      const box = verdict.getBoundingClientRect(), frame = list.getBoundingClientRect();
      if (box.top < frame.top || box.top > frame.bottom - ROOM) list.scrollTop += box.top - frame.top;
    }
  });
  const counts = document.getElementById("counts");
  if (!counts) return;
  const kinds = [...new Set(verdicts.map((verdict) => verdict.dataset.verdict))];
  const kind = element("select", {"aria-label": "Verdict", onchange: () => filter()},
    element("option", {value: ""}, "all"), ...kinds.map((each) => element("option", {value: each}, each)));
  const words = element("input", {type: "search", "aria-label": "Name", placeholder: "name", oninput: () => filter()});
  const left = element("span", {class: "quiet", role: "status"});
  const filter = () => {
    clock.filter = {verdict: kind.value, words: words.value};
    let listed = 0;
    for (const verdict of verdicts) {
      const title = verdict.querySelector(".name").textContent;
      verdict.hidden = !clock.isListed({title, verdict: verdict.dataset.verdict});
      listed += !verdict.hidden;
    }
    left.textContent = listed < verdicts.length ? `${listed} of ${verdicts.length} listed` : "";
    clock.emit("filter");
  };
  counts.append(element("span", {class: "filter"}, kind, words, left));
}

function makeEvents(clock) {
  const place = body("events");
  const {events} = clock.run;
  if (!events.length) {
    place.append(element("p", {}, "No verdict changed, nor any sign for long enough to count."));
    return;
  }
  const rows = events.map((event) => eventRow(event, () => {
    clock.pause();
    goTo(clock, event);
  }));
  const list = element("ol", {class: "list"}, ...rows.map((row) => element("li", {}, row)));
  place.append(list);
  const starts = events.map((event) => event.time);
  let here = null;
  const show = () => {
    const {name, object} = clock.run.results[clock.result] ?? {};
    const now = markedEvent(starts, clock.time, (place) =>
      events[place].specification === name && (events[place].object ?? null) === (object ?? null));
    if (now === here) return;
    if (here !== null && here >= 0) rows[here].removeAttribute("aria-current");
    here = now;
    if (now < 0) return;
    rows[now].setAttribute("aria-current", "true");
    keepInSight(list, rows[now].parentElement);
  };
  clock.on("time", show);
  clock.on("result", show);
}

// The index of the last event that is not later than a time. Of simultaneous events, the chosen result's first event is
// preferred.
function markedEvent(starts, time, isChosen) {
  if (!starts.length || starts[0] > time + 1e-9) return -1;
  const last = indexAt(starts, time);
  for (let place = starts.indexOf(starts[last]); place <= last; place++) if (isChosen(place)) return place;
  return last;
}

function eventRow(event, choose) {
  return element("button", {type: "button", class: "event", onclick: choose},
    mark(event.status), element("time", {}, secondsText(event.time)),
    element("span", {class: "hidden"}, STATUSES[event.status].words),
    element("span", {class: "sentence"}, ...withCode(event.parts)));
}

// Scrolls a list, but not the page around it, so that one of its rows is visible.
function keepInSight(list, row) {
  const top = row.offsetTop;
  if (top < list.scrollTop) list.scrollTop = top;
  else if (top + row.offsetHeight > list.scrollTop + list.clientHeight) {
    list.scrollTop = top + row.offsetHeight - list.clientHeight;
  }
}
