// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/scene/scene.hpp"

namespace wiw::scene::cache {

// What is stored of each type, in order: written once, for the writer and the reader alike. An archive offers
// value (plain data), text, texts, pairs, array (a Buffer, with a checksum), texels (a Buffer without), and of what has
// fields itself: list, and option (a std::optional).

template <class Archive, class T>
void fields_of(Archive& archive, T& texture)
  requires std::is_same_v<std::remove_const_t<T>, Texture>
{
  archive.text(texture.name);
  archive.value(texture.size.height);
  archive.value(texture.size.width);
  archive.texels(texture.rgba);
  archive.value(texture.sampling.u);
  archive.value(texture.sampling.v);
  archive.value(texture.sampling.nearest);
}

template <class Archive, class T>
void fields_of(Archive& archive, T& material)
  requires std::is_same_v<std::remove_const_t<T>, Material>
{
  archive.text(material.name);
  for (int channel = 0; channel < 4; ++channel) archive.value(material.base_color[channel]);
  archive.value(material.texture);
  archive.value(material.alpha_cutoff);
  archive.value(material.emissive);
  archive.value(material.texture_missing);
}

template <class Archive, class T>
void fields_of(Archive& archive, T& mesh)
  requires std::is_same_v<std::remove_const_t<T>, Mesh>
{
  archive.array(mesh.positions);
  archive.array(mesh.normals);
  archive.array(mesh.uv);
  archive.array(mesh.lightmap_uv);
  archive.array(mesh.colors);
  archive.array(mesh.triangles);
  archive.value(mesh.material);
  archive.value(mesh.lightmap);
}

template <class Archive, class T>
void fields_of(Archive& archive, T& instance)
  requires std::is_same_v<std::remove_const_t<T>, Instance>
{
  archive.value(instance.id);
  archive.text(instance.name);
  archive.value(instance.category);
  archive.values(instance.meshes);
  for (int i = 0; i < 16; ++i) archive.value(instance.T_world_instance.matrix().data()[i]);
  archive.pairs(instance.attributes);
}

template <class Archive, class T>
void fields_of(Archive& archive, T& room)
  requires std::is_same_v<std::remove_const_t<T>, Room>
{
  archive.text(room.name);
  archive.text(room.type);
  for (int axis = 0; axis < 3; ++axis) {
    archive.value(room.bounds.min()[axis]);
    archive.value(room.bounds.max()[axis]);
  }
}

template <class Archive, class T>
void fields_of(Archive& archive, T& sun)
  requires std::is_same_v<std::remove_const_t<T>, Sun>
{
  for (int axis = 0; axis < 3; ++axis) archive.value(sun.direction[axis]);
  archive.value(sun.strength);
  archive.value(sun.ambient);
}

template <class Archive, class T>
void fields_of(Archive& archive, T& scene)
  requires std::is_same_v<std::remove_const_t<T>, Scene>
{
  archive.text(scene.name);
  archive.list(scene.textures);
  archive.list(scene.materials);
  archive.list(scene.meshes);
  archive.list(scene.instances);
  archive.list(scene.rooms);
  archive.texts(scene.categories);
  archive.texts(scene.warnings);
  archive.pairs(scene.attributes);
  for (int channel = 0; channel < 3; ++channel) {
    archive.value(scene.sky.zenith[channel]);
    archive.value(scene.sky.horizon[channel]);
  }
  archive.option(scene.sun);
}

}  // namespace wiw::scene::cache
