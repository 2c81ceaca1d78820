"""The paper's printed values and the verdicts on them, figures, tables and the report."""
