"""Where materials and photos for training come from: files, folders, generators, a pool, augmentation.

Readers turn published formats into `SVBRDF`; `pool` caches many of them; `augment` varies a batch.
Nothing here knows of networks or objectives.
"""

from nets.data.images import DataError

__all__ = ["DataError"]
