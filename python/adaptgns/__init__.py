"""AdaptGNS: a learned particle simulator whose interaction graph adapts to its uncertainty.

Import from the modules: ``adaptgns._core`` (graphs and the data generator, in Rust; needs numpy
alone), ``adaptgns.data`` (data sets), ``adaptgns.checkpoint``, ``adaptgns.policies``,
``adaptgns.rollout``.
"""
