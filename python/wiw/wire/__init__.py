# SPDX-License-Identifier: Apache-2.0
"""What goes between a served world model and those who ask it: versioned msgpack messages, never pickle."""
