// Stands for a viewer, by its documented interface for extensions: gives panels React, messages and time.

class Viewer {
  // API: "foxglove" and "lichtblick" read whole ranges, each by its own name; "live" has what is played alone.
  constructor(code, messages, api) {
    this.messages = messages;
    this.api = api;
    this.panels = new Map();
    this.sought = [];
    this.previews = [];
    this.saved = [];
    this.open = 0;
    const module = {exports: {}};
    const modules = {react: React, "react-dom": ReactDOM};
    new Function("module", "require", code)(module, (name) => {
      if (!modules[name]) throw new Error(`no module ${name}`);
      return modules[name];
    });
    module.exports.activate({mode: "test", registerPanel: ({name, initPanel}) => this.panels.set(name, initPanel)});
  }

  // Opens a panel in an element; resolves when its ranges are read.
  async show(name, element, initialState) {
    const {api} = this;
    const watched = new Set();
    let topics = [];
    const ranges = this.ranges = [];
    this.context = {
      panelElement: element,
      initialState,
      watch: (field) => watched.add(field),
      subscribe: (subscriptions) => { topics = subscriptions.map((each) => each.topic); },
      saveState: (state) => this.saved.push(state),
      seekPlayback: (time) => { this.sought.push(time); },
      setPreviewTime: (time) => { this.previews.push(time); },
    };
    const subscribeRange = ({topic, onNewRangeIterator}) => {
      const found = this.messages.filter((each) => each.topic === topic);
      // what the source does not have is never answered for
      if (!found.length) return () => undefined;
      const batches = (async function* () {
        for (let place = 0; place < found.length; place += 100) yield found.slice(place, place + 100);
      })();
      ranges.push(onNewRangeIterator(batches));
      return () => undefined;
    };
    if (api === "foxglove") this.context.subscribeMessageRange = subscribeRange;
    if (api === "lichtblick") this.context.unstable_subscribeMessageRange = subscribeRange;
    this.render = (state) => {
      this.open += 1;
      const seen = Object.fromEntries(Object.entries(state).filter(([field]) => watched.has(field)));
      this.context.onRender(seen, () => { this.open -= 1; });
    };
    this.subscribed = () => topics;
    this.close = this.panels.get(name)(this.context);
    const names = [...new Set(this.messages.map((each) => each.topic))];
    this.render({
      startTime: this.messages[0].receiveTime, colorScheme: this.scheme ?? "light",
      topics: names.map((name) => ({name})),
    });
    await this.settled();
  }

  // Resolves when all ranges are read; a panel that has read one may ask for others.
  async settled() {
    for (let read = -1; read !== this.ranges.length;) {
      read = this.ranges.length;
      await Promise.all(this.ranges);
      await new Promise((resolve) => setTimeout(resolve, 0));
    }
    await this.drawn();
  }

  // Jumps: the newest message of each topic is all that a panel gets.
  seek(time) {
    this.render({currentFrame: this.frameAt(time), currentTime: time, didSeek: true, previewTime: undefined});
  }

  frameAt(time) {
    return this.subscribed().flatMap((topic) => {
      const before = this.messages.filter((each) => each.topic === topic && compare(each.receiveTime, time) <= 0);
      return before.slice(-1);
    });
  }

  // Plays from after one time up to another.
  play(from, to) {
    const topics = new Set(this.subscribed());
    const frame = this.messages.filter((each) => topics.has(each.topic)
      && compare(each.receiveTime, from) > 0 && compare(each.receiveTime, to) <= 0);
    this.render({currentFrame: frame, currentTime: to, didSeek: false, previewTime: undefined});
  }

  hover(seconds) {
    this.render({previewTime: seconds});
  }

  drawn() {
    return new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve, 0)));
  }
}

function compare(a, b) {
  return a.sec - b.sec || a.nsec - b.nsec;
}

function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}
