"""Section III: the paper's smoother and its bound, classical estimators, and their sampled form."""
