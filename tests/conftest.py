"""Every test checks shapes at run time, and fails if ranks are broadcast or dtypes are mixed silently, or on any warning."""

import os

os.environ.setdefault("MUJOCO_GL", "disabled")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads would only wait for each other; XLA has its own threads
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")  # one worker per core

import importlib.util
import sys
from collections.abc import Iterator

from jaxtyping import install_import_hook

install_import_hook("pcil", "beartype.beartype")

import jax
import pytest

from pcil.compilation import use_cache
from pcil.demos import hdf5
from pcil.envs import dmc

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
use_cache()

if importlib.util.find_spec("dm_control") is None:
    real_import = dmc.import_suite

    def skip_or_import() -> object:
        """Skip tests that need DeepMind Control if it is not installed, unless the test itself hides it."""
        if "dm_control" in sys.modules:
            return real_import()
        return pytest.skip("DeepMind Control is not installed", allow_module_level=True)

    dmc.import_suite = skip_or_import


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_end_with_their_file() -> Iterator[None]:
    """Each has some memory mappings of its own. Those of a whole session are more than Linux allows a process (65,530), and
    JAX then crashes."""
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True)
def _datasets_are_read_in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """This saves a quarter of a second per read; test_hostile.py reads in another process, as users do."""
    if request.path.name != "test_hostile.py":
        monkeypatch.setattr(hdf5, "read", hdf5.episodes)


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: pytest.TempPathFactory) -> None:
    """No test leaves files in the project, and none reads the user's own datasets."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
