// Typesets what pymdownx.arithmatex marks. KaTeX 0.16.22 lies beside this file as published, with its woff2 fonts.
document.addEventListener("DOMContentLoaded", () => {
  for (const element of document.querySelectorAll(".arithmatex")) {
    const tex = element.textContent.trim().slice(2, -2) // without \( \) or \[ \]
    katex.render(tex, element, { displayMode: element.tagName === "DIV" })
  }
})
