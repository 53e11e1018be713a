// Search in pages that are opened from disk: browsers refuse workers there, so that a script runs in a frame instead.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(script) {
      super();
      this.waiting = [];
      this.frame = Object.assign(document.createElement("iframe"), { hidden: true });
      addEventListener("message", ({ source, data }) => {
        if (source !== this.frame.contentWindow) return;
        if (data === "worker is ready") {
          this.ready = true;
          this.waiting.splice(0).forEach((message) => this.postMessage(message));
        } else {
          const event = new MessageEvent("message", { data });
          this.dispatchEvent(event);
          this.onmessage?.(event);
        }
      });
      const address = JSON.stringify(String(script)), end = "</" + "script>";
      // What answers within the frame goes to the page; what the worker imports are scripts of the frame.
      this.frame.srcdoc = `<script>
        const page = window.parent;
        window.postMessage = (message) => page.postMessage(message, "*");
        window.importScripts = (...addresses) => Promise.all(addresses.map((src) => new Promise((done, failed) =>
          document.head.append(Object.assign(document.createElement("script"), { src, onload: done, onerror: failed })))));
        importScripts(${address}).then(() => page.postMessage("worker is ready", "*"));
      ${end}`;
      document.body.append(this.frame);
    }
    postMessage(message) {
      if (this.ready) this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data: message }));
      else this.waiting.push(message);
    }
    terminate() {
      this.frame.remove();
    }
  };
}
