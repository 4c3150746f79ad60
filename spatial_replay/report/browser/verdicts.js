// The times in the explanations: choosing one goes there, and to the result that it is told of.

const TOLD_TIME = /\b((?:at|since) )(-?\d+\.\d{3}) s/g;

function linkVerdicts(clock) {
  for (const verdict of document.querySelectorAll(".verdict")) {
    for (const sentence of verdict.querySelectorAll("p")) {
      for (const text of [...sentence.childNodes].filter((node) => node.nodeType === Node.TEXT_NODE)) {
        text.replaceWith(...withLinks(clock, text.data, Number(verdict.dataset.result)));
      }
    }
  }
}

function withLinks(clock, text, result) {
  const parts = [];
  let done = 0;
  for (const found of text.matchAll(TOLD_TIME)) {
    const [all, word, seconds] = found;
    parts.push(text.slice(done, found.index) + word, element("button", {
      type: "button", class: "link",
      onclick: () => {
        clock.pause();
        clock.choose(result);
        clock.seek(Number(seconds));
      },
    }, `${seconds} s`));
    done = found.index + all.length;
  }
  return [...parts, text.slice(done)];
}
