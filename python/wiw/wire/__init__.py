# SPDX-License-Identifier: Apache-2.0
"""Messages between a served world model and its clients: versioned msgpack messages, never pickle."""
