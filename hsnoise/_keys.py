"""Random keys named after what they draw: drawing one more thing leaves all other draws as they were."""

from __future__ import annotations

import zlib

import jax
import numpy as np

from hsnoise._types import RandomKey


def named_key(key: RandomKey, name: str) -> RandomKey:
    """The key that belongs to `name`, from `key`.

    The hash is CRC-32 of the UTF-8 name: unlike Python's `hash`, it is the same in every process.
    """
    return jax.random.fold_in(key, np.uint32(zlib.crc32(name.encode())))
