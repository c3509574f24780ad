// The theme leaves its search dialog without a name that a screen reader could say.
for (const each of document.querySelectorAll("[data-md-component=search]")) each.ariaLabel = "search";
