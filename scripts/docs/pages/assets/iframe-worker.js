// Browsers start no worker for a page opened from a folder: the search then runs in a hidden frame, as with npm's iframe-worker.
if (location.protocol === "file:") {
  const loadScripts = (urls, page) => Promise.all(urls.map((url) => new Promise((loaded, failed) => {
    const script = Object.assign(page.createElement("script"), { src: url, async: false, onload: loaded, onerror: failed })
    page.body.append(script)
  })))

  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.append(this.frame)
      const inside = this.frame.contentWindow
      inside.importScripts = (...urls) => loadScripts(urls, inside.document)
      inside.postMessage = (data) => {
        const event = new MessageEvent("message", { data })
        this.dispatchEvent(event)
        this.onmessage?.(event)
      }
      this.ready = loadScripts([url], inside.document)
    }

    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })))
    }

    terminate() {
      this.frame.remove()
    }
  }
}
