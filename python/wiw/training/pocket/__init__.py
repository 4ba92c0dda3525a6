# SPDX-License-Identifier: Apache-2.0
"""Training of the world model `pocket`, from nothing, on a dataset of `wiw collect navigation`."""
