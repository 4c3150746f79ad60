// Lanes of blocks with words in them: the states of the automaton, and what a planner does.

function stateLane(clock, result) {
  const {automaton, times} = result;
  const blocks = [];
  automaton.path.forEach((code, place) => {
    if (place && code === automaton.path[place - 1]) return;
    if (blocks.length) blocks.at(-1).to = times[place];
    blocks.push({from: times[place], to: clock.end, text: automaton.sets[code].join(", ")});
  });
  return blockLane(clock, "state", `States of the automaton of ${result.title}`, blocks);
}

function decisionLane(clock) {
  const {decisions} = clock.run;
  const blocks = decisions.map(({time, kind, target}, index) => ({
    from: time, to: decisions[index + 1]?.time ?? clock.end, text: target ? `move ${target.object}` : kind,
  }));
  return blockLane(clock, "decision", "Decisions of the planner", blocks);
}

function blockLane(clock, name, title, blocks) {
  const strip = canvas(title, (context, width, height) => {
    const ground = colour("line"), ink = colour("ink");
    context.font = FONT;
    context.textBaseline = "middle";
    for (const {from, to, text} of blocks) {
      const left = Math.max(shareOf(clock, from) * width, 0), right = Math.min(shareOf(clock, to) * width, width);
      if (right < left) continue;
      context.fillStyle = ground;
      context.fillRect(left, 3, Math.max(right - left - 1, 1), height - 6);
      if (context.measureText(text).width + 10 > right - left) continue;
      context.fillStyle = ink;
      context.fillText(text, left + 5, height / 2 + 0.5);
    }
  });
  strip.made.className = "strip";
  scrub(strip.made, clock);
  return {
    made: element("div", {class: "lane"}, element("span", {class: "lane-name part"}, name), strip.made),
    redraw: strip.redraw,
    tell: () => {},
  };
}
