"""Before anything is imported: programs are compiled quickly, and kept for all worker processes, the command line and
the notebooks' kernels.

Compiling is most of the suite's time. XLA without its optimisations compiles in a quarter of the time. What rests on
optimised code (the marker ``optimised``, `make test-lowest`) is tested with an empty XLA_FLAGS, which is left as it is.
The cache is empty when the tests begin and gone when they end.

The workers and some forty processes that tests start read the byte code of the package, whose preparation takes 2 s
each time, so it is kept even where the environment says otherwise. OpenBLAS has one thread in each: for matrices of
this size a second one only waits, at the expense of the other worker.
"""

import atexit
import os
import shutil
import sys
import tempfile
from importlib.metadata import version

# The last one: a program is too small to be compiled in parts, side by side.
_QUICK = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
)
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
given = os.environ.get("XLA_FLAGS")  # flags that are given come last, and so count; an empty variable asks for no other
if version("jaxlib").startswith("0.10.") and given != "":  # an unknown flag would end the process of another release
    os.environ["XLA_FLAGS"] = " ".join((*_QUICK, given or ""))
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="aacmm-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
