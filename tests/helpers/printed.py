"""The estimator that the paper prints."""

from robsmooth import Estimator
from robsmooth.paper.published import paper_plant, printed


def printed_estimator():
    """The estimator with the very digits that the paper prints; it prints no C_a."""
    plant, C_c = paper_plant(), printed("C_c")
    gains = {"A_c": printed("A_c"), "B_c": printed("B_c"), "C_c": C_c}
    return Estimator(plant=plant, **gains, C_a=plant.C_a, C_f=C_c[:1])
