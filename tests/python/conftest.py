# SPDX-License-Identifier: Apache-2.0
"""Puts the folders of all rooms on the path, since some tests use parts of others; pytest adds this one itself."""

import sys

from locations import ROOM_FOLDERS

sys.path.extend(ROOM_FOLDERS)
