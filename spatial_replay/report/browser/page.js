// Puts the panels of a run together.

function makePage(run) {
  document.documentElement.dataset.read = "true";
  const clock = new Clock(run);
  makeTransport(clock, run.events);
  linkVerdicts(clock);
  makeVerdicts(clock);
  makeCamera(clock);
  makeScene(clock);
  makeTree(clock);
  makeLanes(clock);
  makeCurves(clock);
  makeAutomaton(clock);
  makeEvents(clock);
  makeDecisions(clock);
  makeBehaviourTree(clock);
  linkAddress(clock);
  document.documentElement.dataset.ready = "true";
}

readRun().then(makePage).catch(sayWhyNot);
