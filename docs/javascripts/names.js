// Names for screen readers, and the keyboard for tables that scroll: the theme leaves them out, and adds some of these
// elements only when they come into view.
function complete() {
  document.querySelectorAll(".md-search").forEach((search) => search.setAttribute("aria-label", "Search"))
  document.querySelectorAll(".md-code__nav").forEach((nav, index) => nav.setAttribute("aria-label", `Code block ${index + 1}`))
  document.querySelectorAll(".md-typeset__scrollwrap, .md-typeset pre > code").forEach((part) => { part.tabIndex = 0 })
}
complete()
new MutationObserver(complete).observe(document.body, { childList: true, subtree: true })
