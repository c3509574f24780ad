// The theme leaves its search dialog without a name that a screen reader could say.
for (const each of document.querySelectorAll("[data-md-component=search]")) each.ariaLabel = "search";
// A table that is wider than the page scrolls, and must do so with the keyboard too.
const reachable = () => {
  for (const each of document.querySelectorAll(".md-typeset__scrollwrap"))
    if (each.scrollWidth > each.clientWidth) each.tabIndex = 0;
    else each.removeAttribute("tabindex");
};
for (const when of ["load", "resize"]) addEventListener(when, reachable);
