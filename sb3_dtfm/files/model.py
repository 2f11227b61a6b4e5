"""
A saved model: a zip of JSON and safetensors, of which nothing is ever run.

`model.json` names every other member with its size and digest. Members are not compressed, so that none is larger than the
file. The algorithm interprets the numbers; this module only writes them to disk and reads them back, unchanged.
"""

import contextlib
import hashlib
import json
import math
import zipfile
from collections.abc import Iterator, Set
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn

import torch as th
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from stable_baselines3 import __version__ as sb3_version
from stable_baselines3.common.utils import get_system_info

from sb3_dtfm.files.printing import printable
from sb3_dtfm.files.replacing import replacing

FORMAT = 1
CONFIGURATION = "model.json"
SYSTEM_INFO = "system_info.txt"
# Entries that other tools read in a model of Stable-Baselines3.
SB3_VERSION = "_stable_baselines3_version"
TENSORS_SUFFIX = ".safetensors"
PICKLED_DATA = "data"  # JSON, of which a part is pickled
# Members of a file that Stable-Baselines3 itself, or an earlier version of this package, has written.
PICKLED = (PICKLED_DATA, ".pth", ".pkl", ".pt")
OTHER_ALGORITHMS = ("stable_baselines3", "sb3_contrib")  # packages of theirs
MAX_CONFIGURATION = 2**24  # bytes
# Errors of a zip file that is damaged, encrypted, newer than zipfile, or points behind its own end.
DAMAGE = (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError, OverflowError, OSError)


class ModelFileError(ValueError):
    """
    A file is no model that can be loaded.

    :param message: message that names the file, the member, what was found and what is accepted
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class ModelFile(NamedTuple):
    """
    Content of a file.

    :param configuration: values from JSON, without those about the file itself
    :param tensors: tensors by group, for example "policy", and by name
    """

    configuration: dict[str, Any]
    tensors: dict[str, dict[str, th.Tensor]]


def write_model(path: Any, model: ModelFile) -> None:
    """
    :param path: a path, where the file appears when it is complete; or a binary file object
    :param model: content to write
    :raises OSError: names the path
    :raises ValueError: the configuration holds what JSON cannot
    """
    members = {f"{name}{TENSORS_SUFFIX}": save_tensors(_storable(tensors)) for name, tensors in model.tensors.items()}
    about = {name: {"bytes": len(content), "sha256": _digest(content)} for name, content in members.items()}
    configuration = {"format": FORMAT, "members": about, **model.configuration}
    members[CONFIGURATION] = json.dumps(configuration, indent=1, allow_nan=False).encode()
    members[SYSTEM_INFO] = get_system_info(print_info=False)[1].encode()
    members[SB3_VERSION] = sb3_version.encode()
    with contextlib.ExitStack() as stack:
        target = path if hasattr(path, "write") else stack.enter_context(replacing(_with_suffix(Path(path))))
        with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:
            for name, content in members.items():
                archive.writestr(name, content)


def _with_suffix(path: Path) -> Path:
    """Path at which SB3 saves a model: with `.zip` behind a name that has no suffix."""
    return path if path.suffix else path.with_name(f"{path.name}.zip")


def _storable(tensors: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
    return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def read_model(path: Any, groups: Set[str], device: th.device, print_system_info: bool = False) -> ModelFile:
    """
    :param path: a path, with or without `.zip`; or a binary file object
    :param groups: names of the groups of tensors that it has to hold
    :param device: device of the tensors
    :param print_system_info: whether to print the system that the file was saved on
    :raises FileNotFoundError: no such file
    :raises ModelFileError: no model, a damaged one, one with other members than those that it should have, or a newer one
    """
    with _opened(path) as (file, name), _archive(file, name) as archive:
        return _Reader(archive, name).read(groups, device, print_system_info)


def read_configuration(path: Any) -> dict[str, Any]:
    """
    A file's description of its model, without the tensors.

    :param path: see :func:`read_model`
    :raises FileNotFoundError: no such file
    :raises ModelFileError: no model of this package, or a damaged one
    """
    with _opened(path) as (file, name), _archive(file, name) as archive:
        return _Reader(archive, name).configuration()


def holds_pickles(path: Any) -> bool:
    """Return whether this is a model as Stable-Baselines3 itself saves them: loading its `data` runs what they hold."""
    with _opened(path) as (file, name), _archive(file, name) as archive:
        names = archive.namelist()
    return CONFIGURATION not in names and "data" in names


@contextlib.contextmanager
def _archive(file: BinaryIO, name: str) -> Iterator[zipfile.ZipFile]:
    """
    :raises ModelFileError: no zip file, or a damaged one
    """
    try:
        with zipfile.ZipFile(file) as archive:
            yield archive
    except ModelFileError:
        raise
    except DAMAGE as error:
        raise ModelFileError(f"{name}: no model of Stable-Baselines3, or a damaged one: {error}.") from error


def file_name(path: Any) -> str:
    """Name of a path, or of a file object, for messages."""
    return str(getattr(path, "name", "the file object")) if hasattr(path, "read") else str(path)


@contextlib.contextmanager
def _opened(path: Any) -> Iterator[tuple[BinaryIO, str]]:
    """The file, at its start, and what to call it."""
    if hasattr(path, "read"):
        path.seek(0)
        yield path, file_name(path)
        path.seek(0)
        return
    found = Path(path) if Path(path).is_file() else Path(f"{path}.zip")
    if not found.is_file():
        raise FileNotFoundError(2, "No such file", str(path))
    with found.open("rb") as file:
        yield file, str(found)


class _Reader:
    """
    Reads an archive member by member, each only after what it claims to be has been checked.

    :param archive: zip file, open for reading
    :param name: name of the file, for messages
    """

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self.archive = archive
        self.name = name
        self.infos = {info.filename: info for info in archive.infolist()}

    def fail(self, what: str) -> NoReturn:
        raise ModelFileError(f"{self.name}: {what}")

    def read(self, groups: Set[str], device: th.device, print_system_info: bool) -> ModelFile:
        configuration = self.configuration()
        about = self._members(configuration, {f"{group}{TENSORS_SUFFIX}" for group in groups})
        if print_system_info:
            lines = self._content(SYSTEM_INFO, MAX_CONFIGURATION).decode(errors="replace").split("\n")
            print("== SAVED MODEL SYSTEM INFO ==", *map(printable, lines), sep="\n")
        tensors = {name.removesuffix(TENSORS_SUFFIX): self._tensors(name, claimed) for name, claimed in about.items()}
        if device.type != "cpu":
            tensors = {group: {name: each.to(device) for name, each in of.items()} for group, of in tensors.items()}
        return ModelFile(configuration, tensors)

    def configuration(self) -> dict[str, Any]:
        """See :func:`read_configuration`."""
        if len(self.infos) != len(self.archive.infolist()):
            self.fail("a member is there twice.")
        pickled = [name for name in self.infos if name.endswith(PICKLED)]
        if pickled:
            if (library := self._policys_package()) in OTHER_ALGORITHMS:
                self.fail(f"saved by another algorithm, one of {library}.")
            self.fail(
                f"{', '.join(pickled)}: pickled, so loading could run code. If you trust the file, "
                "load(path, allow_pickle=True).save(path) makes one without."
            )
        if CONFIGURATION not in self.infos:
            self.fail(f"no model of DT or DTFM: {CONFIGURATION} is missing.")
        try:
            content = self._content(CONFIGURATION, MAX_CONFIGURATION)
            configuration = json.loads(content, parse_constant=self._no_number, parse_float=self._finite)
        except ModelFileError:
            raise
        except (ValueError, RecursionError) as error:  # also a number of more digits than Python converts
            self.fail(f"{CONFIGURATION} is not JSON: {error}.")
        if not isinstance(configuration, dict):
            self.fail(f"{CONFIGURATION} holds a {type(configuration).__name__}, expected an object.")
        version = configuration.pop("format", None)
        if version != FORMAT:
            newer = "; a newer version of sb3-dtfm wrote it" if isinstance(version, int) and version > FORMAT else ""
            self.fail(f"format {version!r}{newer}; {FORMAT} is accepted.")
        return configuration

    def _policys_package(self) -> str | None:
        """The package of the policy that Stable-Baselines3 has saved, which is not pickled; None if nothing tells."""
        with contextlib.suppress(KeyError, TypeError, ValueError, RecursionError, AttributeError):
            module = json.loads(self._content(PICKLED_DATA, MAX_CONFIGURATION))["policy_class"]["__module__"]
            return str(module.partition(".")[0])
        return None

    def _finite(self, text: str) -> float:
        number = float(text)
        return self._no_number(text) if math.isinf(number) else number  # 1e999

    def _no_number(self, text: str) -> NoReturn:
        self.fail(f"{CONFIGURATION} holds {text}; numbers must be finite.")

    def _members(self, configuration: dict[str, Any], expected: Set[str]) -> dict[str, dict[str, Any]]:
        """The file's description of its tensors."""
        about = configuration.pop("members", None)
        if not isinstance(about, dict) or about.keys() != expected or not all(isinstance(x, dict) for x in about.values()):
            self.fail(f"{CONFIGURATION} does not describe the members {', '.join(sorted(expected))}.")
        known = {CONFIGURATION, SYSTEM_INFO, SB3_VERSION, *expected}
        for name in known - self.infos.keys():
            self.fail(f"{name} is missing.")
        for name in self.infos.keys() - known:
            self.fail(f"{name}: nothing of this name belongs into a model.")
        return about

    def _content(self, name: str, size: int) -> bytes:
        """A member of at most this many bytes."""
        info = self.infos[name]
        if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
            self.fail(f"{name} is compressed; members are stored as they are.")
        if info.file_size > size:
            self.fail(f"{name} claims {info.file_size:,} bytes; at most {size:,} are accepted.")
        with self.archive.open(info) as member:
            content = member.read(size + 1)
        if len(content) != info.file_size:
            self.fail(f"{name} holds {len(content):,} bytes and claims {info.file_size:,}.")
        return content

    def _tensors(self, name: str, claimed: dict[str, Any]) -> dict[str, th.Tensor]:
        size = claimed.get("bytes")
        if not isinstance(size, int) or size != self.infos[name].file_size:
            self.fail(f"{name} has {self.infos[name].file_size:,} bytes, and {CONFIGURATION} says {size}.")
        content = self._content(name, size)
        if _digest(content) != claimed.get("sha256"):
            self.fail(f"{name} is not what was saved: another digest.")
        try:
            return load_tensors(content)
        except (SafetensorError, KeyError, ValueError) as error:
            self.fail(f"{name}: {error}.")
