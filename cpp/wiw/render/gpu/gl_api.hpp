// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <GL/glcorearb.h>

namespace wiw::render::gpu {

// Every OpenGL function in use: member name, C type.
#define WIW_GL_FUNCTIONS(X)                                    \
  X(ActiveTexture, PFNGLACTIVETEXTUREPROC)                     \
  X(AttachShader, PFNGLATTACHSHADERPROC)                       \
  X(BindBuffer, PFNGLBINDBUFFERPROC)                           \
  X(BindBufferRange, PFNGLBINDBUFFERRANGEPROC)                 \
  X(BindFramebuffer, PFNGLBINDFRAMEBUFFERPROC)                 \
  X(BindSampler, PFNGLBINDSAMPLERPROC)                         \
  X(BindTexture, PFNGLBINDTEXTUREPROC)                         \
  X(BindVertexArray, PFNGLBINDVERTEXARRAYPROC)                 \
  X(BufferData, PFNGLBUFFERDATAPROC)                           \
  X(BufferSubData, PFNGLBUFFERSUBDATAPROC)                     \
  X(CheckFramebufferStatus, PFNGLCHECKFRAMEBUFFERSTATUSPROC)   \
  X(ClearBufferfv, PFNGLCLEARBUFFERFVPROC)                     \
  X(ClearBufferuiv, PFNGLCLEARBUFFERUIVPROC)                   \
  X(ClipControl, PFNGLCLIPCONTROLPROC)                         \
  X(CompileShader, PFNGLCOMPILESHADERPROC)                     \
  X(CreateProgram, PFNGLCREATEPROGRAMPROC)                     \
  X(CreateShader, PFNGLCREATESHADERPROC)                       \
  X(DeleteBuffers, PFNGLDELETEBUFFERSPROC)                     \
  X(DeleteFramebuffers, PFNGLDELETEFRAMEBUFFERSPROC)           \
  X(DeleteProgram, PFNGLDELETEPROGRAMPROC)                     \
  X(DeleteShader, PFNGLDELETESHADERPROC)                       \
  X(DeleteSamplers, PFNGLDELETESAMPLERSPROC)                   \
  X(DeleteTextures, PFNGLDELETETEXTURESPROC)                   \
  X(DeleteVertexArrays, PFNGLDELETEVERTEXARRAYSPROC)           \
  X(DepthFunc, PFNGLDEPTHFUNCPROC)                             \
  X(DepthMask, PFNGLDEPTHMASKPROC)                             \
  X(Disable, PFNGLDISABLEPROC)                                 \
  X(DrawArrays, PFNGLDRAWARRAYSPROC)                           \
  X(DrawBuffers, PFNGLDRAWBUFFERSPROC)                         \
  X(DrawElements, PFNGLDRAWELEMENTSPROC)                       \
  X(Enable, PFNGLENABLEPROC)                                   \
  X(EnableVertexAttribArray, PFNGLENABLEVERTEXATTRIBARRAYPROC) \
  X(FramebufferTextureLayer, PFNGLFRAMEBUFFERTEXTURELAYERPROC) \
  X(GenBuffers, PFNGLGENBUFFERSPROC)                           \
  X(GenFramebuffers, PFNGLGENFRAMEBUFFERSPROC)                 \
  X(GenSamplers, PFNGLGENSAMPLERSPROC)                         \
  X(GenTextures, PFNGLGENTEXTURESPROC)                         \
  X(GenVertexArrays, PFNGLGENVERTEXARRAYSPROC)                 \
  X(GetBufferSubData, PFNGLGETBUFFERSUBDATAPROC)               \
  X(GetError, PFNGLGETERRORPROC)                               \
  X(GetIntegerv, PFNGLGETINTEGERVPROC)                         \
  X(GetProgramInfoLog, PFNGLGETPROGRAMINFOLOGPROC)             \
  X(GetProgramiv, PFNGLGETPROGRAMIVPROC)                       \
  X(GetShaderInfoLog, PFNGLGETSHADERINFOLOGPROC)               \
  X(GetShaderiv, PFNGLGETSHADERIVPROC)                         \
  X(GetString, PFNGLGETSTRINGPROC)                             \
  X(GetStringi, PFNGLGETSTRINGIPROC)                           \
  X(GetUniformBlockIndex, PFNGLGETUNIFORMBLOCKINDEXPROC)       \
  X(GetUniformLocation, PFNGLGETUNIFORMLOCATIONPROC)           \
  X(LinkProgram, PFNGLLINKPROGRAMPROC)                         \
  X(PixelStorei, PFNGLPIXELSTOREIPROC)                         \
  X(ReadBuffer, PFNGLREADBUFFERPROC)                           \
  X(ReadPixels, PFNGLREADPIXELSPROC)                           \
  X(SamplerParameteri, PFNGLSAMPLERPARAMETERIPROC)             \
  X(Scissor, PFNGLSCISSORPROC)                                 \
  X(ShaderSource, PFNGLSHADERSOURCEPROC)                       \
  X(TexImage2D, PFNGLTEXIMAGE2DPROC)                           \
  X(TexImage3D, PFNGLTEXIMAGE3DPROC)                           \
  X(TexParameteri, PFNGLTEXPARAMETERIPROC)                     \
  X(Uniform1i, PFNGLUNIFORM1IPROC)                             \
  X(Uniform2fv, PFNGLUNIFORM2FVPROC)                           \
  X(Uniform3fv, PFNGLUNIFORM3FVPROC)                           \
  X(UniformBlockBinding, PFNGLUNIFORMBLOCKBINDINGPROC)         \
  X(UseProgram, PFNGLUSEPROGRAMPROC)                           \
  X(VertexAttribPointer, PFNGLVERTEXATTRIBPOINTERPROC)         \
  X(Viewport, PFNGLVIEWPORTPROC)

/// Function table of one context, filled through eglGetProcAddress.
struct Gl {
#define WIW_GL_MEMBER(name, type) type name = nullptr;
  WIW_GL_FUNCTIONS(WIW_GL_MEMBER)
#undef WIW_GL_MEMBER
};

}  // namespace wiw::render::gpu
