"""Learned policies, and the gaits they are compared with.

config     every setting of an experiment, frozen
evaluate   the harness: one way to run a controller and to measure it
gaits      sinusoidal gaits by computed torque, tuned by differential evolution
train      PPO with Stable-Baselines3, checkpointed
compare    all of it, in parallel, into a table and a figure
"""
