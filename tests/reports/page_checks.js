// What tests/reports/test_report_in_browser.py asks a page.
({
  // Texts whose contrast is below 4.5, and their contrast.
  unreadable: () => {
    const luminance = (rgb) => {
      const [r, g, b] = rgb.map((v) => v / 255).map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
      return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const numbers = (text) => (text.match(/[\d.]+/g) || []).map(Number);
    const behind = (node) => {
      for (; node; node = node.parentElement) {
        const found = numbers(getComputedStyle(node).backgroundColor);
        if (found.length === 3 || found[3] > 0) return found.slice(0, 3);
      }
      return [255, 255, 255];
    };
    const bad = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      const parent = walker.currentNode.parentElement;
      if (!walker.currentNode.textContent.trim() || ["script", "style"].includes(parent.localName)) continue;
      const style = getComputedStyle(parent);
      const drawn = parent.namespaceURI.endsWith("svg") ? style.fill : style.color;
      const pair = [numbers(drawn).slice(0, 3), behind(parent)].map(luminance).sort((a, b) => b - a);
      const ratio = (pair[0] + 0.05) / (pair[1] + 0.05);
      if (ratio < 4.5) bad.push([walker.currentNode.textContent.trim().slice(0, 40), ratio]);
    }
    return bad;
  },
  // How many pixels of each canvas are drawn.
  drawn: () => [...document.querySelectorAll("canvas")].map((canvas) => {
    const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    let count = 0;
    for (let k = 3; k < pixels.length; k += 4) count += pixels[k] > 0;
    return count;
  }),
  // What ends beyond the window.
  tooWide: () => [...document.querySelectorAll("main *")]
    .filter((node) => !node.closest(".scroll, pre, svg") && node.getBoundingClientRect().right > innerWidth + 1)
    .map((node) => node.className || node.tagName),
  // Smallest size of a text in each figure, as shown, px.
  smallestText: () => [...document.querySelectorAll("figure svg")].map((svg) => {
    const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
    const sizes = [...svg.querySelectorAll("text")].map((text) => parseFloat(getComputedStyle(text).fontSize));
    return scale * Math.min(...sizes);
  }),
})
