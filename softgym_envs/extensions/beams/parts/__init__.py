"""Learned parts: elastic parts between two frames, known by an energy over the relative pose of their ports.

A part is learned once, without dimensions, and used in any body that has it, any number of times. It is an element of
the mechanics (`softgym_envs.extensions.beams.elements`), so statics, motion and ``W`` are those of finite elements.
"""
