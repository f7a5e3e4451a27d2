"""Scenes drawn by formula, with exact true paths and depth.

Scenes
    room      a furnished room, through a handheld camera
    flat      the same with bare walls and few things
    street    a drive through streets, with traffic
    block     the same, once round a block and on
    lorry     the street, behind a lorry
    orbit     a still life on a table, from all sides
    survey    fields and farms, from a drone
    corridor  bare corridors, from a small robot
    office    desks, shelves and bare corners, through a handheld camera

Drawing
    render    a scene as a recorded sequence
    surfaces  textured rectangles, and what a pinhole camera sees of them
    textures  what is painted on them
    optics    lens distortion
    motion    where cameras look, and how they shake
"""
