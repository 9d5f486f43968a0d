"""Who made a run: records signed with a key of the user's own, and short hashes of what they say.

A run's config.json can name classes of others, and to import a module is to execute it. A
record that this user's Credo wrote is signed with a key in the user's own folder, so that such a
run goes on without a word; one from elsewhere must be trusted first. Nothing random enters what a
run computes: champions and checkpoints hold hashes alone.
"""

import hashlib
import hmac
import json
import os
import pathlib
import secrets
import warnings
from collections.abc import Mapping
from typing import Any

from . import files

SIZE = 32  # bytes of a key
SIGNATURE, CHECKSUM = "signature", "sha256"  # of a record; the second is of the first too


def canonical(value: Any) -> bytes:
    """JSON that is the same for equal values, whatever the order of their keys."""
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def short(value: Any) -> str:
    """64 bits of the SHA-256 of a JSON value."""
    return hashlib.sha256(canonical(value)).hexdigest()[:16]


def seal(record: Mapping[str, Any]) -> dict[str, Any]:
    """What a champion and a checkpoint say of the run that they belong to. Nothing in it is random,
    and each part stands alone, so that a message can say which one differs."""
    return {
        "algorithm": short(record["algorithm"]),
        "seed": record["seed"],
        "budget": record.get("budget"),
        "versions": short(record.get("machine", {}).get("versions")),
    }


def sign(record: Mapping[str, Any]) -> str | None:
    """HMAC-SHA256 of all that a record says of its run; None if there can be no key."""
    key = _key(make=True)
    return None if key is None else _code(record, key)


def signed_here(record: Mapping[str, Any]) -> bool:
    """Whether this user's key signed the record as it is now."""
    given, key = record.get(SIGNATURE), _key(make=False)
    if key is None or not isinstance(given, str):
        return False
    return hmac.compare_digest(given.encode(), _code(record, key).encode())


def key_path() -> pathlib.Path | None:
    """Where this user's key lies; None if the user has no folder."""
    base = os.environ.get("XDG_CONFIG_HOME")
    if base and os.path.isabs(base):
        return pathlib.Path(base) / "credo" / "key"
    try:
        home = pathlib.Path.home()
    except RuntimeError:  # no HOME, and this user is unknown
        return None
    return home / ".config" / "credo" / "key" if home.is_absolute() else None


def _code(record: Mapping[str, Any], key: bytes) -> str:
    said = {k: v for k, v in record.items() if k not in (SIGNATURE, CHECKSUM)}
    return hmac.new(key, canonical(said), hashlib.sha256).hexdigest()


def _key(*, make: bool) -> bytes | None:
    """This user's key, made if there is none and it is to be; None, with a warning if it was to be
    made, if there can be none."""
    path = key_path()
    try:
        if path is None:
            raise ValueError("this user has no home folder")
        if make and not path.exists():
            _make(path)
        return _read(path)
    except (OSError, ValueError) as error:
        if make:
            warnings.warn(
                f"runs made now are not signed, since there is no key for it ({error}): those with "
                "classes of your own will go on only with --trust",
                stacklevel=3,
            )
        return None


def _read(path: pathlib.Path) -> bytes:
    """The key, if no other user can know or choose it."""
    status = os.stat(path)
    if hasattr(os, "geteuid") and status.st_uid != os.geteuid():
        raise ValueError(f"{path} belongs to another user")
    if status.st_mode & 0o077:
        raise ValueError(f"{path} can be read or written by others: `chmod 600 {path}`")
    key = files.read_bytes(path, most=SIZE)
    if len(key) != SIZE:
        raise ValueError(f"{path} has {len(key)} bytes, not {SIZE}: remove it")
    return key


def _make(path: pathlib.Path) -> None:
    """A new key, unless another process makes one at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    files.remove(draft)
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with open(descriptor, "wb") as file:
            file.write(secrets.token_bytes(SIZE))
            file.flush()
            os.fsync(descriptor)
        try:
            os.link(draft, path)
        except FileExistsError:
            pass
        except OSError:  # a file system without hard links
            os.replace(draft, path)
    finally:
        files.remove(draft)
