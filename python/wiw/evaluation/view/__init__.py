# SPDX-License-Identifier: Apache-2.0
"""A run to walk through: a list of all its episodes, and a page for each, as plain files that need no server."""

from wiw.evaluation.view.site import Site, write_view

__all__ = ["Site", "write_view"]
