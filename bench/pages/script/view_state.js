// What a reader has chosen. It lives in the page's address, so that a view can be kept and sent.

const state = {
  chosen: new Map(),
  listeners: [],

  read() {
    this.chosen = new Map();
    const text = location.hash.slice(1);
    // A bare name is the anchor of a section.
    if (!text.includes("=")) return;
    for (const part of text.split("&")) {
      const [key, value] = part.split("=", 2);
      this.chosen.set(decodeURIComponent(key), decodeURIComponent(value));
    }
  },

  get(key, fallback = "") {
    return this.chosen.has(key) ? this.chosen.get(key) : fallback;
  },

  // Nothing is kept of what is as it was at first.
  set(key, value, fallback = "") {
    if (value === fallback) this.chosen.delete(key);
    else this.chosen.set(key, value);
    const parts = [...this.chosen].map((pair) => pair.map(encodeURIComponent).join("="));
    const address = `${location.pathname}${location.search}${parts.length ? `#${parts.join("&")}` : ""}`;
    try {
      history.replaceState(null, "", address);
    } catch {
      // Within a frame a page has no address of its own: the view lasts as long as the page.
    }
    for (const listener of this.listeners) listener(key);
  },

  off() {
    return new Set(this.get("off").split(",").filter(Boolean).map(decodeURIComponent));
  },

  switchOff(names) {
    this.set("off", [...names].map(encodeURIComponent).join(","));
  },

  listen(act) {
    this.listeners.push(act);
  },
};

state.read();
