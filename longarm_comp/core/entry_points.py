"""Code from outside this package: objects of other packages' entry points, and Python files."""

import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from longarm_comp.core.errors import InputError


def of_other_packages(group: str) -> Iterator[tuple[str, Any, str]]:
    """Yield name, object and origin of each entry point, by name; InputError if one cannot load."""
    for point in sorted(entry_points(group=group), key=lambda p: p.name):
        package = f"package {point.dist.name} {point.dist.version}" if point.dist else "a package"
        source = f"{package}, entry point {point.name}"
        try:
            found = point.load()
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
            raise InputError(source, "class", said, f"{point.value} that can be loaded") from error
        yield point.name, found, source


def protocols_of_other_packages(group: str, base: type) -> Iterator[tuple[Any, str]]:
    """Yield class and origin of each entry point; InputError if it is no such class of `base`."""
    for name, kind, source in of_other_packages(group):
        if not (isinstance(kind, type) and issubclass(kind, base)) or inspect.isabstract(kind):
            allowed = f"a class of {base.__name__}, nothing abstract"
            raise InputError(source, "class", repr(kind), allowed)
        check_name(name, getattr(kind, "name", ""), "protocol", source)
        yield kind, source


def check_name(entry: str, own: str, what: str, source: str) -> None:
    """Raise InputError if an entry point and the object behind it have different names."""
    if entry != own:
        raise InputError(source, "name", entry, f"the {what}'s own, {own}")


def execute_file(path: Path, what: str) -> ModuleType:
    """Return the module of a Python file, which is executed once for the same contents.

    Args:
        what: what the file must define, for error messages.

    Raises:
        InputError: there is no such file, or it cannot be executed.
    """
    if not path.is_file():
        raise InputError(path, what, "missing", f"a Python file that defines {what}")
    text = path.read_bytes()
    digest = hashlib.sha256(bytes(path.resolve()) + text).hexdigest()[:16]
    name = f"longarm_{what}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(path, what, path.suffix, "a Python file, .py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        said = f"{type(error).__name__}: {error}"
        raise InputError(path, what, said, "a Python file that can be executed") from error
    return module
