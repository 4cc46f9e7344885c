"""Lets other people's imports of a package find one of nmr's, in this process."""

from __future__ import annotations

import importlib.util
import sys
import types
from itertools import accumulate


def alias_package(here: str, name: object, replace: bool, example: str, remedy: str) -> None:
    """From now on the package ``here`` is also found as ``name``, with its modules.

    ``example`` is a name and ``remedy`` a command for the errors: ValueError for a name that no
    import could have, ImportError if there is another package of that name and ``replace`` is
    False.
    """
    if not isinstance(name, str) or not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"name must be one of a module, like {example!r}, got {name!r}")
    if sys.modules.get(name) is not sys.modules[here]:
        _make_parents(name)
        if not replace and (found := _find(name)):
            raise ImportError(
                f"there is another package {name}, {found}; uninstall it ({remedy}), or call install_as(replace=True)"
            )
        for module in [key for key in sys.modules if key == name or key.startswith(f"{name}.")]:
            del sys.modules[module]
    # With the modules, too: an import of one would otherwise read its file a second time, as part
    # of another package.
    for key, module in list(sys.modules.items()):
        if key == here or key.startswith(f"{here}."):
            sys.modules[name + key.removeprefix(here)] = module


def _make_parents(name: str) -> None:
    """Empty packages in place of those that do not exist, so that Python reaches a name with
    dots.
    """
    for parent in [*accumulate(name.split("."), "{}.{}".format)][:-1]:
        if parent not in sys.modules and importlib.util.find_spec(parent) is None:
            sys.modules[parent] = types.ModuleType(parent)
            sys.modules[parent].__path__ = []


def _find(name: str) -> str | None:
    """Place of the module of that name. None if it is missing, or a folder without code, such as
    a checkout.
    """
    if name in sys.modules:
        return f"already imported from {getattr(sys.modules[name], '__file__', None) or 'an unknown place'}"
    spec = importlib.util.find_spec(name)
    return None if spec is None else spec.origin
