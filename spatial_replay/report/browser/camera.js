// What the camera saw at the cursor, and a strip of small pictures.

function makeCamera(clock) {
  const {topic, reason, times, pictures} = clock.run.camera ?? {topic: ""};
  if (!topic) return;
  const place = body("camera");
  if (reason) {
    place.append(element("p", {class: "quiet"}, reason));
    return;
  }
  const shown = element("img", {class: "picture"});
  const caption = element("figcaption", {class: "caption"});
  const strip = element("div", {class: "pictures", role: "group", "aria-label": "Pictures"});
  strip.append(...times.map((time, index) => element("button", {
    type: "button", title: secondsText(time), "aria-label": `Picture at ${secondsText(time)}`,
    onclick: () => {
      clock.pause();
      clock.seek(time);
    },
  }, element("img", {src: pictures[index], alt: "", decoding: "async"}))));
  place.append(element("figure", {class: "camera"}, shown, caption), strip);
  let before = -1;
  const show = () => {
    const index = indexAt(times, clock.time);
    if (index === before) return;
    strip.children[before]?.removeAttribute("aria-current");
    before = index;
    const chosen = strip.children[index];
    chosen.setAttribute("aria-current", "true");
    shown.src = pictures[index];
    shown.alt = `What the camera saw at ${secondsText(times[index])}`;
    caption.textContent = `${topic}, as it was at ${secondsText(times[index])}`;
    // the strip scrolls, not the page
    strip.scrollTop = chosen.offsetTop - strip.offsetTop - (strip.clientHeight - chosen.offsetHeight) / 2;
  };
  clock.on("time", show);
}
