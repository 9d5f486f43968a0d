"""Our `jit`: floats are data, sizes are part of the program."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from credo import compilation


class Scale(eqx.Module):
    factor: float = 2.0
    power: int = eqx.field(static=True, default=1)


@pytest.fixture
def traced():
    """A compiled function and the list of its traces."""
    traces = []

    @compilation.jit
    def scaled(scale, x, *, offset=0.0):
        """Documented."""
        traces.append(scale)
        return scale.factor * x**scale.power + offset

    return scaled, traces


def test_a_new_float_does_not_compile_again(traced):
    scaled, traces = traced
    x = jnp.array([1.0, 2.0])
    assert scaled(Scale(2.0), x).tolist() == [2.0, 4.0]
    assert scaled(Scale(3.0), x).tolist() == [3.0, 6.0]
    assert scaled(Scale(3.0), x, offset=0.0).tolist() == [3.0, 6.0]
    assert scaled(Scale(3.0), x, offset=1.0).tolist() == [4.0, 7.0]
    assert len(traces) == 2  # without and with the keyword


def test_a_new_size_does(traced):
    scaled, traces = traced
    x = jnp.array([1.0, 2.0])
    assert scaled(Scale(2.0, power=2), x).tolist() == [2.0, 8.0]
    assert scaled(Scale(2.0, power=3), x).tolist() == [2.0, 16.0]
    assert len(traces) == 2


def test_results_are_float32_and_the_name_is_kept(traced):
    scaled, _ = traced
    assert scaled(Scale(), jnp.array([1.0])).dtype == jnp.float32
    assert scaled.__doc__ == "Documented."


def test_the_cache_lies_where_the_user_said():
    compilation.enable_cache()
    assert jax.config.jax_compilation_cache_dir == str(compilation.cache_directory() / "xla")


@pytest.mark.parametrize("name", ["CREDO_CACHE", "XDG_CACHE_HOME", "HOME"])
def test_without_a_folder_to_write_in_nothing_is_kept_and_that_is_said_once(
    monkeypatch, tmp_path, name
):
    for variable in ("CREDO_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert compilation.cache_directory() == tmp_path / ".cache" / "credo"
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv(name, str(tmp_path / "file"))
    assert compilation.cache_directory() is None
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    compilation.enable_cache.cache_clear()
    try:
        with pytest.warns(UserWarning, match="set CREDO_CACHE to a folder that can"):
            compilation.enable_cache()
        compilation.enable_cache()  # a warning would be an error
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_a_user_without_a_home_has_no_cache(monkeypatch):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    for variable in ("CREDO_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("pathlib.Path.home", nobody)
    assert compilation.cache_directory() is None
