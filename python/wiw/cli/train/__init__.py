# SPDX-License-Identifier: Apache-2.0
"""`wiw train NAME`: a module for each network, or family of networks, that it trains."""
