"""Learned policies, and the gaits they are compared with.

config      every setting of an experiment, frozen
metrics     what is measured of an episode
evaluate    the harness: one way to run a controller and to measure it
statistics  interquartile means with intervals, over seeds and episodes
gaits       sinusoidal gaits, by computed torque or as torques
laws        laws in closed form that go farther, a file for each mechanism
tuning      differential evolution of gaits and laws
train       PPO with Stable-Baselines3, checkpointed
sweep       PPO with many settings
compare     all of it, in parallel, into a table and a figure
policies    trained policies as plain files, run by NumPy alone
export      writes them
rl_zoo      the settings as a hyperparameter file of RL Baselines3 Zoo
"""
