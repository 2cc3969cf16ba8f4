"""Names of a package that are imported when they are asked for: a worker process needs few of them, and none of PyTorch."""

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any


class Lazy:
    """
    What a package's ``__getattr__`` asks.

    :param package: its name
    :param names: each name that can be asked for, and the module below the package that holds it
    :param modules: further modules below the package that can be asked for
    """

    def __init__(self, package: str, names: Mapping[str, str], modules: Sequence[str] = ()) -> None:
        self.package, self.names, self.modules = package, names, modules

    def __call__(self, name: str) -> Any:
        """
        :param name: what is asked for
        :return: it, which the package has from now on
        :raises AttributeError: if there is no such thing
        """
        if name in self.names:
            found = getattr(import_module(f"{self.package}.{self.names[name]}"), name)
        elif name in self.modules:
            found = import_module(f"{self.package}.{name}")
        else:
            raise AttributeError(f"module {self.package!r} has no attribute {name!r}")
        setattr(sys.modules[self.package], name, found)
        return found
