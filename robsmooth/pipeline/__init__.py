"""The notebooks as one checked run: parameters, processes, freshness, published results."""

from robsmooth.pipeline.parameters import PipelineError
from robsmooth.pipeline.runner import NotebookResult, Places, run_notebooks

__all__ = ["NotebookResult", "PipelineError", "Places", "run_notebooks"]
