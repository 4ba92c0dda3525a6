// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/mesh_file.hpp"

#include <assimp/config.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>

#include <algorithm>
#include <assimp/Importer.hpp>
#include <cctype>
#include <cmath>

#include "wiw/core/error.hpp"
#include "wiw/physics/shape.hpp"
#include "wiw/scene/import.hpp"
#include "wiw/scene/import/collada_check.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/guarded_io.hpp"
#include "wiw/scene/import/ply_header.hpp"

namespace wiw::physics {

namespace fs = std::filesystem;

namespace {

constexpr std::uintmax_t kMaxBytes = 256u << 20;  // meshes of links are at most a few megabytes
constexpr float kSmooth = 40;                     // degrees between faces that are one curve

std::string extension_of(const fs::path& path) {
  std::string extension = path.extension().string();
  std::ranges::transform(extension, extension.begin(), [](unsigned char c) { return std::tolower(c); });
  return extension;
}

/// A mesh file of a link, open for reading.
class MeshFile {
 public:
  MeshFile(fs::path path, std::string link) : path_(std::move(path)), link_(std::move(link)) {}

  [[nodiscard]] FileError error(const std::string& cause) const {
    return FileError(path_.string(), cause + " (mesh of link '" + link_ + "')");
  }

  const aiScene& read(unsigned steps) {
    std::error_code code;
    const std::uintmax_t bytes = fs::file_size(path_, code);
    if (code) throw error("no such file");
    if (bytes > kMaxBytes) throw error("larger than 256 MiB, which a mesh of a link has no need of");
    check_damage();
    // NOLINTNEXTLINE(*-owning-memory): the importer owns it
    importer_.SetIOHandler(new scene::GuardedIo(options_, extension_of(path_) == ".obj"));
    importer_.SetPropertyBool(AI_CONFIG_IMPORT_COLLADA_IGNORE_UP_DIRECTION, true);  // URDF knows the file's axes only
    importer_.SetPropertyInteger(AI_CONFIG_PP_SBP_REMOVE, aiPrimitiveType_LINE | aiPrimitiveType_POINT);
    importer_.SetPropertyInteger(AI_CONFIG_PP_RVC_FLAGS, aiComponent_NORMALS);
    importer_.SetPropertyFloat(AI_CONFIG_PP_GSN_MAX_SMOOTHING_ANGLE, kSmooth);
    const aiScene* scene = importer_.ReadFile(path_.string(), 0);
    if (scene == nullptr) name_link([&] { scene::rethrow_own_error(importer_); });
    if (scene == nullptr) throw error(importer_.GetErrorString());
    for (unsigned m = 0; m < scene->mNumMeshes; ++m) check_faces(*scene->mMeshes[m]);
    scene = importer_.ApplyPostProcessing(aiProcess_ValidateDataStructure);
    if (scene != nullptr) scene = importer_.ApplyPostProcessing(steps | aiProcess_PreTransformVertices);
    if (scene == nullptr) throw error("it has no faces that can be used: " + std::string(importer_.GetErrorString()));
    for (unsigned m = 0; m < scene->mNumMeshes; ++m) check(*scene->mMeshes[m]);
    return *scene;
  }

  /// The file as a scene in its own axes: glTF is not assimp's to read.
  [[nodiscard]] scene::ScenePtr read_gltf() const {
    scene::ImportOptions options;
    options.up = scene::Up::kY;
    options.limits.file_bytes = kMaxBytes;
    scene::ScenePtr scene;
    name_link([&] { scene = scene::load_mesh(path_, options); });
    return scene;
  }

 private:
  /// Adds the link to an error of `read`'s.
  template <class Read>
  void name_link(const Read& read) const {
    try {
      read();
    } catch (const FileError& damage) {
      const std::string text = damage.what();
      const std::string own = path_.string() + ": ";
      throw error(text.starts_with(own) ? text.substr(own.size()) : text);
    }
  }

  /// What assimp does not survive.
  void check_damage() const {
    name_link([&] {
      if (extension_of(path_) == ".ply") scene::check_ply(path_);
      if (extension_of(path_) == ".dae") scene::check_collada(path_);
    });
  }

  /// The steps that follow take for granted that every face has corners and that every corner is a vertex.
  void check_faces(const aiMesh& mesh) const {
    for (unsigned f = 0; f < mesh.mNumFaces; ++f) {
      const aiFace& face = mesh.mFaces[f];
      if (face.mNumIndices == 0) throw error("face " + std::to_string(f) + " has no corners (damaged file)");
      for (unsigned i = 0; i < face.mNumIndices; ++i) {
        if (face.mIndices[i] < mesh.mNumVertices) continue;
        throw error("face " + std::to_string(f) + " names vertex " + std::to_string(face.mIndices[i]) + " of " +
                    std::to_string(mesh.mNumVertices) + " (damaged file)");
      }
    }
  }

  void check(const aiMesh& mesh) const {
    const auto finite = [](const aiVector3D& v) {
      return std::isfinite(v.x) && std::isfinite(v.y) && std::isfinite(v.z);
    };
    for (unsigned v = 0; v < mesh.mNumVertices; ++v) {
      if (!finite(mesh.mVertices[v])) throw error("a vertex is not finite");
      if (mesh.HasNormals() && !finite(mesh.mNormals[v])) throw error("a normal is not finite");
    }
  }

  const fs::path path_;
  const std::string link_;
  const scene::ImportOptions options_{.limits = {.file_bytes = kMaxBytes}};  // the importer reads by it
  Assimp::Importer importer_;
};

/// STL knows faces alone: its normals would show every curve as facets.
bool is_stl(const fs::path& path) { return extension_of(path) == ".stl"; }

bool is_gltf(const fs::path& path) { return extension_of(path) == ".glb" || extension_of(path) == ".gltf"; }

Eigen::Vector3f to_eigen(const aiVector3D& v) { return {v.x, v.y, v.z}; }

/// Of the file's own materials; those that assimp makes up have no say.
Eigen::Vector4f color_of(const aiScene& scene, const aiMesh& mesh) {
  const aiMaterial& material = *scene.mMaterials[mesh.mMaterialIndex];
  aiColor4D color;
  const bool own = std::string(material.GetName().C_Str()) != AI_DEFAULT_MATERIAL_NAME;
  if (!own || material.Get(AI_MATKEY_COLOR_DIFFUSE, color) != AI_SUCCESS) return Eigen::Vector4f::Zero();
  return {color.r, color.g, color.b, 1.f};
}

void append(const aiScene& scene, const aiMesh& mesh, const Eigen::Vector3f& scale, VisualMesh& surface) {
  const auto first = static_cast<std::uint32_t>(surface.positions.size());
  const Eigen::Vector4f color = color_of(scene, mesh);
  for (unsigned v = 0; v < mesh.mNumVertices; ++v) {
    surface.positions.emplace_back(scale.cwiseProduct(to_eigen(mesh.mVertices[v])));
    surface.normals.push_back(to_eigen(mesh.mNormals[v]).cwiseQuotient(scale).normalized());
    const aiColor4D* own = mesh.mColors[0];
    surface.colors.push_back(own == nullptr ? color : Eigen::Vector4f(own[v].r, own[v].g, own[v].b, 1.f));
  }
  for (unsigned f = 0; f < mesh.mNumFaces; ++f) {
    const unsigned* corners = mesh.mFaces[f].mIndices;
    surface.triangles.emplace_back(first + corners[0], first + corners[1], first + corners[2]);
  }
}

/// The mean of the normals of a vertex's triangles, weighted by their area.
std::vector<Eigen::Vector3f> smooth_normals(const scene::Mesh& mesh) {
  std::vector<Eigen::Vector3f> normals(mesh.positions.size(), Eigen::Vector3f::Zero());
  for (const scene::Triangle& t : mesh.triangles) {
    const Eigen::Vector3f& corner = mesh.positions[t[0]];
    const Eigen::Vector3f normal = (mesh.positions[t[1]] - corner).cross(mesh.positions[t[2]] - corner);
    for (int k = 0; k < 3; ++k) normals[t[k]] += normal;
  }
  return normals;
}

void append(const scene::Scene& scene, const scene::Mesh& mesh, const Eigen::Affine3f& placement,
            const Eigen::Vector3f& scale, VisualMesh& surface) {
  const auto first = static_cast<std::uint32_t>(surface.positions.size());
  const std::vector<Eigen::Vector3f> normals =
      mesh.normals.empty() ? smooth_normals(mesh)
                           : std::vector<Eigen::Vector3f>(mesh.normals.begin(), mesh.normals.end());
  const Eigen::Vector4f color = mesh.material == scene::kNone
                                    ? Eigen::Vector4f(Eigen::Vector4f::Zero())
                                    : scene.materials[static_cast<std::size_t>(mesh.material)].base_color;
  for (std::size_t v = 0; v < mesh.positions.size(); ++v) {
    surface.positions.emplace_back(scale.cwiseProduct(placement * mesh.positions[v]));
    surface.normals.push_back((placement.linear() * normals[v]).cwiseQuotient(scale).normalized());
    const auto own = [&] { return (mesh.colors[v].cast<float>() / 255.f).eval(); };
    surface.colors.push_back(mesh.colors.empty() ? color : own());
    surface.colors.back()[3] = mesh.colors.empty() && mesh.material == scene::kNone ? 0.f : 1.f;
  }
  for (const scene::Triangle& t : mesh.triangles) surface.triangles.emplace_back(first + t.array());
}

/// Calls `use` with every mesh of a scene and its placement.
template <class Use>
void for_each_mesh(const scene::Scene& scene, const Use& use) {
  for (const scene::Instance& instance : scene.instances) {
    for (const std::uint32_t mesh : instance.meshes) use(scene.meshes[mesh], instance.T_world_instance);
  }
}

void check_scale(const MeshFile& file, const Eigen::Vector3d& scale) {
  if (!scale.allFinite() || (scale.array() == 0).any()) throw file.error("expected finite factors of scale, none zero");
}

VisualMesh read_surface(const fs::path& path, const Eigen::Vector3d& scale, const std::string& link) {
  MeshFile file(path, link);
  check_scale(file, scale);
  if (is_gltf(path)) {
    const scene::ScenePtr scene = file.read_gltf();
    VisualMesh surface;
    for_each_mesh(*scene, [&](const scene::Mesh& mesh, const Eigen::Affine3f& placement) {
      append(*scene, mesh, placement, scale.cast<float>(), surface);
    });
    return surface;
  }
  unsigned steps =
      aiProcess_Triangulate | aiProcess_SortByPType | aiProcess_GenSmoothNormals | aiProcess_JoinIdenticalVertices;
  if (is_stl(path)) steps |= aiProcess_RemoveComponent;
  const aiScene& scene = file.read(steps);
  VisualMesh surface;
  for (unsigned m = 0; m < scene.mNumMeshes; ++m) append(scene, *scene.mMeshes[m], scale.cast<float>(), surface);
  if (surface.triangles.empty()) throw file.error("it has no triangles");
  return surface;
}

std::vector<Eigen::Vector3d> read_points(MeshFile& file, const fs::path& path) {
  std::vector<Eigen::Vector3d> points;
  if (is_gltf(path)) {
    for_each_mesh(*file.read_gltf(), [&](const scene::Mesh& mesh, const Eigen::Affine3f& placement) {
      for (const Eigen::Vector3f& position : mesh.positions) points.emplace_back((placement * position).cast<double>());
    });
    return points;
  }
  const aiScene& scene = file.read(aiProcess_JoinIdenticalVertices);
  for (unsigned m = 0; m < scene.mNumMeshes; ++m) {
    const aiMesh& mesh = *scene.mMeshes[m];
    for (unsigned v = 0; v < mesh.mNumVertices; ++v) points.emplace_back(to_eigen(mesh.mVertices[v]).cast<double>());
  }
  return points;
}

std::vector<Eigen::Vector3d> read_hull(const fs::path& path, const Eigen::Vector3d& scale, const std::string& link) {
  MeshFile file(path, link);
  check_scale(file, scale);
  std::vector<Eigen::Vector3d> points = read_points(file, path);
  for (Eigen::Vector3d& point : points) point = scale.cwiseProduct(point);
  const HullMesh hull = hull_mesh(points);
  if (hull.vertices.empty()) throw file.error("its vertices span no volume");
  return hull.vertices;
}

}  // namespace

VisualMesh surface_of_file(const fs::path& path, const Eigen::Vector3d& scale, const std::string& link) {
  return scene::read_as_file(path, [&] { return read_surface(path, scale, link); });
}

std::vector<Eigen::Vector3d> hull_of_file(const fs::path& path, const Eigen::Vector3d& scale, const std::string& link) {
  return scene::read_as_file(path, [&] { return read_hull(path, scale, link); });
}

fs::path find_mesh(const std::string& name, const fs::path& folder) {
  const std::string package = "package://", file = "file://";
  if (name.starts_with(file)) return name.substr(file.size());
  if (!name.starts_with(package)) return folder / name;
  const fs::path inside = name.substr(package.size());
  const fs::path rest = inside.lexically_relative(*inside.begin());
  for (fs::path at = fs::absolute(folder);; at = at.parent_path()) {
    if (fs::exists(at / inside)) return at / inside;
    if (at.filename() == *inside.begin() && fs::exists(at / rest)) return at / rest;
    if (at == at.parent_path()) break;
  }
  return folder / inside;
}

}  // namespace wiw::physics
