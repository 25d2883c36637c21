// Wide tables scroll by the keyboard, too. Bars of buttons beside code have names of their own for screen readers.
addEventListener("load", () => {
  document.querySelectorAll(".md-typeset__scrollwrap").forEach((box) => { box.tabIndex = 0 })
  document.querySelectorAll(".md-code__nav").forEach((bar, number) => { bar.ariaLabel = `Code ${number + 1}` })
})
