// Pages that explain come before entries of the reference, unless a name is typed in full.
Scorer.objPrio = {0: 0, 1: -8, 2: -10};
Scorer.score = ([page, , , , score]) => score - (page.startsWith("api/") ? 4 : 0);
