// Search on pages from disk, where browsers refuse workers: a worker's script runs in a hidden frame instead.
if (location.protocol === "file:") window.Worker = class extends EventTarget {
  constructor(url) {
    super();
    const frame = document.body.appendChild(Object.assign(document.createElement("iframe"), {hidden: true}));
    this.inside = frame.contentWindow;
    this.inside.document.write("<body></body>");
    this.inside.document.close();
    this.inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", {data}));
    const script = this.inside.document.createElement("script");
    this.ready = new Promise(loaded => { script.onload = loaded; });
    script.src = url;
    this.inside.document.body.appendChild(script);
  }
  postMessage(data) {
    this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", {data})));
  }
};
