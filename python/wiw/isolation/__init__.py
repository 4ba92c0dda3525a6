# SPDX-License-Identifier: Apache-2.0
"""Models and policies of one's own in processes of their own, which never held a simulator; see `docs/firewall.md`."""
