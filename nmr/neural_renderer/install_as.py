"""Lets code that imports ``neural_renderer`` find this package, unchanged."""

from __future__ import annotations

import importlib.util
import sys

_HERE = __package__  # "nmr.neural_renderer"


def install_as(name: str = "neural_renderer", *, replace: bool = False) -> None:
    """From now on, ``import neural_renderer`` in this process means this package, and so do imports of its modules.

    Call it once, before other people's code is imported. ``import neural_renderer as nr``, ``from
    neural_renderer.projection import projection`` and the like then work there as written. Nothing is written to disk.

    Parameters
    ----------
    name : str
        The name under which that code imports the package; with dots if it lies in a package of theirs
        ("external.neural_renderer").
    replace : bool
        Take the name also if a package of that name is installed or already imported. Code that has imported it keeps
        what it has.

    Raises
    ------
    ImportError
        If there is such a package, and ``replace`` is False.
    ValueError
        For a name that no import could have.

    >>> nr.install_as()
    >>> from neural_renderer.projection import projection
    """
    if not isinstance(name, str) or not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"name must be one of a module, like 'neural_renderer', got {name!r}")
    here = sys.modules[_HERE]
    if sys.modules.get(name) is not here:
        if not replace and (found := _find(name)):
            raise ImportError(
                f"there is another package {name}, {found}; uninstall it (pip uninstall neural_renderer_pytorch), or "
                "call install_as(replace=True)"
            )
        for module in [key for key in sys.modules if key == name or key.startswith(f"{name}.")]:
            del sys.modules[module]
    # With the modules, too: an import of one would otherwise read its file a second time, as part of another package.
    for key, module in list(sys.modules.items()):
        if key == _HERE or key.startswith(f"{_HERE}."):
            sys.modules[name + key.removeprefix(_HERE)] = module


def _find(name: str) -> str | None:
    """Where a module of that name lies, if there is one."""
    if name in sys.modules:
        return f"already imported from {getattr(sys.modules[name], '__file__', None) or 'an unknown place'}"
    spec = importlib.util.find_spec(name)
    return None if spec is None else spec.origin or ", ".join(spec.submodule_search_locations)
