"""What is true of the paper: printed values and the verdicts on them, figures, tables, report."""
