// How the results of Sphinx's search are ordered: guides first, then explanations, then the reference, and the
// changelog last. Entries of the index that a page states (```{index}) count in full, those of the glossary little.
var Scorer = {
  objNameMatch: 11,
  objPartialMatch: 4,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
  score: ([page, title, anchor, description, score, file, kind]) => {
    if (kind === "object") return score;
    if (page.startsWith("reference/glossary")) return score / 10;
    if (page.startsWith("changelog")) return score - 40;
    if (page.startsWith("reference/") || page.startsWith("notebooks/")) return score - 10;
    if (page === "troubleshooting") return score + 8;
    return /^(how_to|readers)\/|^(start|install|which_data)$/.test(page) ? score + 4 : score;
  },
};
