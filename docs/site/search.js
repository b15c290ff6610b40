/* Search options such as --hold-out: the search reads a leading hyphen as "without this word". */
document.querySelector("input.md-search__input").addEventListener("input", ({ target }) => {
  const text = target.value.replace(/(^|\s)-+(?=\w)/g, "$1");
  if (text !== target.value) target.value = text;
});
