# SPDX-License-Identifier: Apache-2.0
"""`wiw train NAME`: one module per network, or family of networks."""
