"""Symbols and shorthands of Bullo and Zefran's sections 4 and 5, without the misprint in D."""

from __future__ import annotations

import sympy as sp

m, l, J_r, J_w, l_1, l_2, I_1, I_2, u_psi, u_phi = sp.symbols("m l J_r J_w l_1 l_2 I_1 I_2 u_psi u_phi")
x, y, theta, psi, phi = sp.symbols("x y theta psi phi")
v1, v2, v3 = sp.symbols("v1 v2 v3")

D = m * l**2 - J_r * sp.sin(phi) ** 2
c, H = l_2 + l_1 * sp.cos(psi), l_1 + l_2 * sp.cos(psi)
k = l_2 * I_1 - l_1 * I_2 * sp.cos(psi)
f_1 = m * c**2 + (I_1 + I_2) * sp.sin(psi) ** 2
f_2 = m * l_2**2 * I_1 + m * l_1**2 * I_2 * sp.cos(psi) ** 2 + I_1 * I_2 * sp.sin(psi) ** 2
f_3 = l_1 * I_2 - l_2 * I_1 * sp.cos(psi) + m * l_1 * l_2 * c
