"""Laws as formulas in what is measured, as data that C is written from, and as the reference step."""
