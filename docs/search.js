// A page that is opened from the disk may not start a worker: there the search runs in a frame, by the same script.
if (location.protocol === "file:")
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.body.appendChild(document.createElement("iframe"));
      const inside = frame.contentWindow;
      frame.hidden = true;
      inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = inside.document.body.appendChild(inside.document.createElement("script"));
      this.loaded = new Promise((resolve) => script.addEventListener("load", () => resolve(inside)));
      script.src = url;
    }
    async postMessage(data) {
      const inside = await this.loaded;
      inside.dispatchEvent(new inside.MessageEvent("message", { data }));
    }
  };
