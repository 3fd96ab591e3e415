"""Hashes of passwords, made with scrypt (RFC 7914), so that a file of users does not reveal its passwords.

A hash is the text ``scrypt$N$R$P$SALT$KEY``: the three cost parameters, and salt and key in hex.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets

LONGEST = 200
"""The largest number of characters of a password."""
_N, _R, _P = 1 << 14, 8, 1
_SALT_BYTES = 16
_KEY_BYTES = 32
_COSTS = tuple(1 << bits for bits in range(12, 16))
"""The accepted values of N, which limit the time and the memory of one comparison."""
_MOST_MEMORY = 64 * 1024 * 1024


def hash_of(password: str) -> str:
    """Return a new hash of a password, with a random salt."""
    salt = secrets.token_bytes(_SALT_BYTES)
    return f"scrypt${_N}${_R}${_P}${salt.hex()}${_key(password, salt, _N, _R, _P).hex()}"


def unmatchable_hash() -> str:
    """Return a hash that no known password has, without the 70 ms of CPU time that `hash_of` needs; `matches` needs them."""
    return f"scrypt${_N}${_R}${_P}${secrets.token_hex(_SALT_BYTES)}${secrets.token_hex(_KEY_BYTES)}"


def is_hash(text: str) -> bool:
    """Return whether `text` is a hash that `matches` can compare with."""
    try:
        _parsed(text)
    except ValueError:
        return False
    return True


def matches(password: str, stored: str) -> bool:
    """Return whether `password` has the hash `stored`. Raises `ValueError` if `stored` is not a hash."""
    n, r, p, salt, key = _parsed(stored)
    return hmac.compare_digest(_key(password, salt, n, r, p), key)


def _parsed(stored: str) -> tuple[int, int, int, bytes, bytes]:
    kind, *parts = stored.split("$")
    if kind != "scrypt" or len(parts) != 5:
        raise ValueError("not a hash of scrypt")
    n, r, p = (int(each) for each in parts[:3])
    if n not in _COSTS or not 1 <= r <= 8 or not 1 <= p <= 4:
        raise ValueError("a cost parameter is outside its limits")
    salt, key = bytes.fromhex(parts[3]), bytes.fromhex(parts[4])
    if len(salt) < _SALT_BYTES or len(key) != _KEY_BYTES:
        raise ValueError("salt or key has a wrong length")
    return n, r, p, salt, key


def _key(password: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    data = password[:LONGEST].encode(errors="surrogateescape")
    return hashlib.scrypt(data, salt=salt, n=n, r=r, p=p, maxmem=_MOST_MEMORY, dklen=_KEY_BYTES)
