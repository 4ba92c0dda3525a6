# SPDX-License-Identifier: Apache-2.0
"""World models: `base` has the contract; a model is a module, a family of models a folder."""
