from .definition import Study as Study
from .executors import dask_executor as dask_executor
from .results import open_study as open_study
from .runner import run_study as run_study
from .sources import make_study as make_study
from .sources import read_study as read_study
from .sources import shipped_studies as shipped_studies
