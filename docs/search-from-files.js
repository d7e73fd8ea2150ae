// Browsers give pages that are opened as files no workers, and the search needs one: here its
// script runs in a hidden frame instead, with a worker's messages, which are copies.
if (location.protocol === "file:") {
  const told = (data) => new MessageEvent("message", { data: structuredClone(data) })

  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.append(this.frame)
      const inside = this.frame.contentWindow
      inside.postMessage = (data) => {
        const event = told(data)
        this.dispatchEvent(event)
        this.onmessage?.(event)
      }
      const script = inside.document.createElement("script")
      script.src = new URL(url, location.href)
      this.ready = new Promise((loaded) => script.addEventListener("load", loaded))
      inside.document.body.append(script)
    }

    postMessage(data) {
      const event = told(data)
      this.ready.then(() => this.frame.contentWindow?.dispatchEvent(event))
    }

    terminate() {
      this.frame.remove()
    }
  }
}
