"""Section III-A and further: the errors of an estimator, nominal, at the worst, and guaranteed."""
