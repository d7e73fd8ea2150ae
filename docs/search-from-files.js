// The search needs a web worker, which browsers refuse to pages opened from files. Run its script
// in a hidden frame instead, and copy the messages as for a worker.
if (location.protocol === "file:") {
  const makeEvent = (data) => new MessageEvent("message", { data: structuredClone(data) })

  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.append(this.frame)
      const inside = this.frame.contentWindow
      inside.postMessage = (data) => {
        const event = makeEvent(data)
        this.dispatchEvent(event)
        this.onmessage?.(event)
      }
      const script = inside.document.createElement("script")
      script.src = new URL(url, location.href)
      this.ready = new Promise((loaded) => script.addEventListener("load", loaded))
      inside.document.body.append(script)
    }

    postMessage(data) {
      const event = makeEvent(data)
      this.ready.then(() => this.frame.contentWindow?.dispatchEvent(event))
    }

    terminate() {
      this.frame.remove()
    }
  }
}
