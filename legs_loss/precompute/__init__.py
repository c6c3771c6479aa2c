"""Compute the normalised response of every photograph of a scene, and write the store for all later trainings.

Views are distributed to processes, each with one photograph in memory at a time. Finished maps are in the store within
about a second, so an interrupted or killed run can be resumed. A view is up to date, and left alone, while its
photograph's file has the size and time of change that were recorded, its map's checksum holds, and size, operator and
background are those asked for.
"""

from __future__ import annotations

from legs_loss.precompute.one_scene import Report as Report
from legs_loss.precompute.one_scene import precompute as precompute
from legs_loss.precompute.photograph import normalised_map as normalised_map
from legs_loss.precompute.photograph import response_map as response_map
from legs_loss.precompute.user_maps import UserMaps as UserMaps
