"""robsmooth: robust continuous-time fixed-lag smoothing for nonlinear uncertain systems."""

from robsmooth._names import PUBLIC as __all__
from robsmooth._names import find


def __getattr__(name):
    """Import a public name, or say what a name of elsewhere is called here."""
    globals()[name] = value = find(name)
    return value


def __dir__():
    return list(__all__)
