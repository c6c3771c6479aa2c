"""Stores of normalised responses on disk, from which the weight maps of every curve and beta are made.

A store is a folder: ``manifest.json`` and one ``.npy`` a view, size and operator, float16 [H, W]. The user's own masks
and weights lie beside the responses, so that curve and beta can still be chosen later. A map of 1 is exact;
elsewhere float16 rounds E^ by at most 2^-12, and small values by at most 1 part in 2048.

Readers open only the manifest, which is replaced atomically, so they need no lock. Writers stage maps in a
folder of their own and move them in, with the manifest, under a lock: a file that the manifest does not list is a
leftover of a killed writer, and the next writer deletes it.
"""

from __future__ import annotations

from legs_loss.store.fingerprints import fingerprint as fingerprint
from legs_loss.store.fingerprints import sampled_fingerprint as sampled_fingerprint
from legs_loss.store.manifest import MANIFEST as MANIFEST
from legs_loss.store.manifest import MASK as MASK
from legs_loss.store.manifest import WEIGHTS as WEIGHTS
from legs_loss.store.manifest import DamagedStoreError as DamagedStoreError
from legs_loss.store.manifest import Entry as Entry
from legs_loss.store.maps import is_intact as is_intact
from legs_loss.store.maps import read_map as read_map
from legs_loss.store.maps import stage as stage
from legs_loss.store.reading import Found as Found
from legs_loss.store.reading import WeightStore as WeightStore
from legs_loss.store.writing import StoreWriter as StoreWriter
