"""Write the sample files beside this one with VTK itself: python tests/data/vtk/write.py

Needs the package vtk, which the tests do not. Made with VTK 9.7.2.
"""

from pathlib import Path

import numpy as np
import vtk
from vtk.util.numpy_support import numpy_to_vtk

HERE = Path(__file__).parent
# A triangle, a square and a pentagon side by side, and a point that no face uses.
POINTS = [
    [0, 0, 0],
    [1, 0, 0],
    [1, 1, 0],
    [0, 1, 0],
    [2, 0, 0.5],
    [3, 0, 1],
    [3, 1, 1],
    [2, 2, 0.5],
]
POINTS += [[9, 9, 9]]
POLYGONS = [[0, 1, 2], [4, 5, 6, 7], [0, 1, 6, 7, 3]]
STRIP = [0, 1, 3, 2, 7]


def data(cells, strips=()):
    found = vtk.vtkPolyData()
    points = vtk.vtkPoints()
    points.SetData(numpy_to_vtk(np.array(POINTS), deep=True))
    found.SetPoints(points)
    for setter, lists in ((found.SetPolys, cells), (found.SetStrips, strips)):
        array = vtk.vtkCellArray()
        for cell in lists:
            array.InsertNextCell(len(cell), cell)
        setter(array)
    scalar = numpy_to_vtk(np.arange(9.0), deep=True)
    scalar.SetName("value")
    found.GetPointData().AddArray(scalar)
    found.GetPointData().SetNormals(numpy_to_vtk(np.array(POINTS), deep=True))
    return found


def xml(name, mode, compressor=None, *, base64=True, order="Little", header=64, content=None):
    writer = vtk.vtkXMLPolyDataWriter()
    writer.SetInputData(content or data(POLYGONS))
    writer.SetFileName(str(HERE / f"{name}.vtp"))
    getattr(writer, f"SetDataModeTo{mode}")()
    writer.SetEncodeAppendedData(base64)
    writer.SetCompressorType({None: 0, "zlib": 1, "lz4": 2, "lzma": 3}[compressor])
    writer.SetBlockSize(64)
    getattr(writer, f"SetByteOrderTo{order}Endian")()
    getattr(writer, f"SetHeaderTypeToUInt{header}")()
    writer.Write()


def legacy(name, *, binary, version, content=None):
    writer = vtk.vtkPolyDataWriter()
    writer.SetInputData(content or data(POLYGONS))
    writer.SetFileName(str(HERE / f"{name}.vtk"))
    writer.SetFileVersion(version)
    writer.SetFileTypeToBinary() if binary else writer.SetFileTypeToASCII()
    writer.Write()


def grid():
    """The same faces, and an edge, as an unstructured grid."""
    found = vtk.vtkUnstructuredGrid()
    found.SetPoints(data([]).GetPoints())
    cells = [(vtk.VTK_TRIANGLE, (0, 1, 2)), (vtk.VTK_QUAD, (4, 5, 6, 7))]
    cells += [(vtk.VTK_POLYGON, (0, 1, 6, 7, 3)), (vtk.VTK_LINE, (0, 8))]
    for kind, corners in cells:
        found.InsertNextCell(kind, len(corners), corners)
    return found


if __name__ == "__main__":
    xml("text", "Ascii")
    xml("inline", "Binary")
    xml("inline_zlib", "Binary", "zlib", header=32)
    xml("appended_zlib", "Appended", "zlib", header=32)  # VTK's default
    xml("appended", "Appended", header=32)
    xml("raw", "Appended", base64=False)
    xml("raw_zlib", "Appended", "zlib", base64=False)
    xml("raw_lzma_big", "Appended", "lzma", base64=False, order="Big")
    xml("raw_lz4", "Appended", "lz4", base64=False)
    strips = data([], [STRIP])
    xml("strips", "Appended", "zlib", content=strips)
    xml("cloud", "Appended", "zlib", content=data([]))
    legacy("text_4", binary=False, version=42)
    legacy("text_5", binary=False, version=51)
    legacy("binary_4", binary=True, version=42)
    legacy("binary_5", binary=True, version=51)
    legacy("strips", binary=True, version=51, content=strips)
    legacy("cloud", binary=True, version=51, content=data([]))
    for name, version in (("grid_4", 42), ("grid_5", 51)):
        writer = vtk.vtkUnstructuredGridWriter()
        writer.SetInputData(grid())
        writer.SetFileVersion(version)
        writer.SetFileTypeToBinary()
        writer.SetFileName(str(HERE / f"{name}.vtk"))
        writer.Write()
    writer = vtk.vtkXMLUnstructuredGridWriter()
    writer.SetInputData(grid())
    writer.SetFileName(str(HERE / "grid.vtu"))
    writer.Write()
