// Puts the page together once the run is read.

function makePage(run) {
  document.documentElement.dataset.read = "true";
  const clock = new Clock(run);
  makeTransport(clock, run.events);
  linkVerdicts(clock);
  makeScene(clock);
  makeTree(clock);
  makeLanes(clock);
  makeCurves(clock);
  makeAutomaton(clock);
  makeEvents(clock);
  makeDecisions(clock);
  keepInAddress(clock);
  document.documentElement.dataset.ready = "true";
}

readRun().then(makePage).catch((error) => {
  const said = element("p", {class: "notice alert", role: "alert"},
    `This browser cannot show the run: ${error.message}. Verdicts and explanations are complete.`);
  document.getElementById("main").prepend(said);
  console.error(error);
});
