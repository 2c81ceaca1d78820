"""One BLAS thread for the many small problems here: more cost several times what they save."""

from threadpoolctl import ThreadpoolController

one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")
"""Decorator: the function runs with one BLAS thread; what calls it keeps its own number."""
