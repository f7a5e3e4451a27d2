import numpy as np

from semcast.server.geometry.cells import cell_keys


def test_cells_of_an_image_and_around_it_have_a_number_each():
    column, row = np.meshgrid(np.arange(-2, 40), np.arange(-2, 30))
    cells = np.stack([column.ravel(), row.ravel()], axis=1)
    assert len(np.unique(cell_keys(cells))) == len(cells)
