# SPDX-License-Identifier: Apache-2.0
"""An agent's map of a place, from depth, labels and odometry alone: objects, free space, routes, landmarks.

Everything is in the frame of the episode's start: x forward, y left, z up, in metres, the floor at z = 0; azimuths in
radians, left positive. Nothing here knows the simulator, a question or a model.
"""
