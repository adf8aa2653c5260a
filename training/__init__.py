"""Learned policies, and the gaits they are compared with.

config      every setting of an experiment, frozen; `options` reads them from the command line, `store` keeps results
metrics     what is measured of an episode
evaluate    the harness: one way to run a controller and to measure it
statistics  interquartile means with intervals, over seeds and episodes
gaits       sinusoidal gaits, by computed torque or as torques; they see what `observed` reads
laws        laws in closed form that go farther, a file for each mechanism
tuning      gaits and laws tuned by differential `evolution`, which `family` makes of their settings
predictions what theory says of gaits: with `prescribed` joints, and for fast torques by `averaging`
optimal     the strongest known way forward: `climbing` by linear programs, `shooting` through the simulator
train       PPO with Stable-Baselines3, checkpointed, in environments that `wrappers` change; its policies are in
            `time_aware`, and in `levels` those that choose torques from a few
sweep       PPO with many settings
compare     all of it, in parallel (`progress`), into a table (`report`) and a figure (`plots`)
film        films of controllers side by side; `shapes` draws their loops over height functions
policies    trained policies as plain files, run by NumPy alone
export      writes them
rl_zoo      the settings as a hyperparameter file of RL Baselines3 Zoo
"""
