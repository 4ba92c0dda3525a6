# SPDX-License-Identifier: Apache-2.0
"""Video generators that were trained to follow actions (paper, section "Post-Training Recipe")."""
