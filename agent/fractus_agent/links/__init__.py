"""Direct links of a node: hearing peers, pairing with one by node certificates, supervising the link, ending it."""
