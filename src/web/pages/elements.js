// Colours of the elements, close to those of other programs (C. Levinthal and the CPK models; Jmol). Names and the table tell elements
// apart, so that no colour has to.

const COLOURS = { H: [225, 225, 225], He: [180, 235, 235], Li: [180, 110, 240], Be: [170, 230, 20], B: [245, 170, 170], C: [110, 110, 110], N: [60, 90, 240],
  O: [235, 40, 30], F: [120, 215, 80], Na: [160, 90, 225], Mg: [100, 200, 20], Al: [190, 160, 160], Si: [230, 190, 140], P: [245, 130, 20], S: [235, 215, 50],
  Cl: [40, 220, 40], K: [140, 70, 200], Ca: [70, 205, 20], Ti: [180, 184, 190], V: [160, 160, 170], Cr: [130, 150, 200], Mn: [150, 120, 200], Fe: [220, 105, 55],
  Co: [235, 140, 155], Ni: [80, 195, 85], Cu: [200, 125, 55], Zn: [125, 130, 175], Ga: [190, 140, 140], Ge: [100, 140, 140], As: [185, 130, 220],
  Se: [245, 165, 20], Br: [160, 45, 40], Zr: [145, 215, 215], Nb: [115, 190, 200], Mo: [85, 175, 175], Ru: [40, 140, 140], Pd: [20, 110, 135], Ag: [185, 185, 185],
  Sn: [105, 130, 130], Hf: [80, 190, 245], Ta: [80, 165, 245], W: [35, 145, 210], Re: [40, 125, 170], Pt: [205, 205, 220], Au: [250, 205, 40], Pb: [90, 92, 100] };
/** For the others, by their place in the structure. */
const OTHERS = [[213, 94, 0], [0, 114, 178], [204, 121, 167], [0, 158, 115], [181, 137, 0]];

/** The colour of each element of a list, as [r, g, b]. */
export function elementColours(species) {
  const others = [...new Set(species)].filter((one) => !COLOURS[one]).sort();
  return Object.fromEntries([...new Set(species)].sort().map((one) => [one, COLOURS[one] ?? OTHERS[others.indexOf(one) % OTHERS.length]]));
}
