# SPDX-License-Identifier: Apache-2.0
"""Post-training of video generators to follow actions (paper, appendix "Post-Training Recipe").

    from wiw.training.post_training.train import post_train
    post_train("ltx-action", "data", "runs/ltx", weights="/models/ltx")

`docs/post-training.md` describes it.
"""
