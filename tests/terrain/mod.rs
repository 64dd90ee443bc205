//! Ground of any shape is one ground for everything that meets it.

mod heightfields_make_pits;
mod heights_are_one_surface;
mod heights_count_from_the_ground;
mod levels_change_at_an_episodes_end;
mod mesh_obstacles_are_read_once;
mod obstacles_are_one_terrain;
mod rays_meet_what_a_slow_walk_meets;
mod rough_terrain_is_one_terrain;
mod tiles_are_what_their_numbers_say;
